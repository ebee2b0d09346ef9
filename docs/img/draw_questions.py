"""Draws questions.png, questions about the whole world of the arrow puzzle: ``python docs/img/draw_questions.py``."""

from pathlib import Path

import numpy as np

from imagine_bench import registry
from imagine_bench.arrays import Pixels, State
from imagine_bench.judge.worlds.making import whole_world
from imagine_bench.recording.filmstrips import png, sheet
from imagine_bench.rules import states_of_play
from imagine_bench.tools.quiz import rows_of

ROWS = {"masked frame": 3, "shortest plan": 120, "luck alone": 1, "single-cause pairs": 0}
"""The question of each family that is drawn."""


def main() -> None:
    """Draw them below one another."""
    spec = registry.task("arrow_puzzle")
    asked = whole_world(spec, states_of_play(spec.rules), 2, looks=True)
    rng = np.random.default_rng(0)

    def render(state: State) -> Pixels:
        return spec.render_macrostates(np.array([state]), "clean", rng)[0]

    rows = []
    for family in asked.families:
        if family.name in ROWS:
            for words in family.words(asked.named, ROWS[family.name]):
                rows += rows_of(words, render, family.name)
                print(family.name, words.text, *words.answers, sep="\n  ")
    (Path(__file__).parent / "questions.png").write_bytes(png(sheet(rows)))


if __name__ == "__main__":
    main()
