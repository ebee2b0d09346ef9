"""Encoders, studies, regression tasks and regressors that packages beside this one offer."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from guest_packages import Guests
from imagine_bench.agents.encoders import training
from imagine_bench.agents.encoders.encoder import Encoder
from imagine_bench_motion.judge.interface import GROUP, motion_model_entry, motion_models
from small_runs import benched

from imagine_bench import registry
from imagine_bench.cli import exit_code as main
from imagine_bench.errors import ArtefactError, InvalidValueError, SetupError
from imagine_bench.protocols.data import RunSpec
from imagine_bench.registry.machine import versions
from imagine_bench.regression.runner import run
from imagine_bench.running.bench import plan
from imagine_bench.running.trained import encoder_of_run, load_trained
from imagine_bench.store import encoders

_OFFERS = {
    registry.ENCODER_GROUP: {
        "tiles": "their_things:TILES",
        "corners": "their_things:CORNERS",
        "blind": "their_things:BLIND",
        "broken": "their_things:Tiles",
    },
    registry.STUDY_GROUP: {"their_study": "their_things:STUDY", "smoke": "their_things:STUDY"},
    registry.REGRESSION_GROUP: {"their_data": "their_things:DATA"},
    registry.REGRESSOR_GROUP: {
        "their_regressor": "their_things:REGRESSOR",
        "their_plain_regressor": "their_things:PLAIN",
    },
    GROUP: {"their_motion_model": "their_things:MOTION", "no_entry": "their_things:STUDY"},
}
_MODULE = '''
import dataclasses
import numpy as np
from imagine_bench import registry
from imagine_bench.registry import EncoderEntry, RegressorEntry
from imagine_bench.sweep.grid import Study, Variant
from imagine_bench_motion.judge.interface import MotionModelEntry

class Tiles:
    """Mean colors of 16 tiles, in thousands, so that somebody must scale them."""
    def encode(self, frames):
        return 1000.0 * frames.reshape(len(frames), 4, 16, 4, 16, 3).mean(axis=(2, 4)).reshape(len(frames), 48) / 255.0
    def decode(self, latents):
        return (latents.reshape(-1, 4, 4, 3) / 1000.0).repeat(16, axis=1).repeat(16, axis=2)

class Corners:
    """Whether the left and the right half are brighter above than below, each a factor of two values."""
    code_sizes = (2, 2)
    def encode(self, frames):
        halves = frames.reshape(len(frames), 2, 32, 2, 32, 3).mean(axis=(2, 4, 5))
        return np.eye(2)[(halves[:, 0] > halves[:, 1]).astype(int)].reshape(len(frames), 4)

class Blind:
    def encode(self, frames):
        return np.full((len(frames), 3), np.nan)

TILES = EncoderEntry(make="their_things:Tiles")
CORNERS = EncoderEntry(make="their_things:Corners")
BLIND = EncoderEntry(make="their_things:Blind")
RANDOM = Variant(name="random", factor="base", agent="random")
STUDY = Study(name="their_study", question="Whose?", budgets=(2,), variants=(RANDOM,))
DATA = dataclasses.replace(registry.regression("toy_regression"), id="their_data", variants=("base",))
MOTION = MotionModelEntry(make="their_things:Tiles", level="commands", description="A model.")
REGRESSOR = RegressorEntry(
    make="imagine_bench_regression.regressor:make_mc_dropout",
    title="theirs",
    description="A regressor.",
    settings="imagine_bench_regression.settings:HYPERPARAMETERS",
)
PLAIN = dataclasses.replace(REGRESSOR, settings="")
'''


@pytest.fixture(autouse=True)
def things(guests: Guests, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guests.write("their_things", _MODULE, _OFFERS)
    monkeypatch.setenv("IMAGINE_BENCH_CACHE", str(tmp_path / "cache"))
    few = replace(training.OFFERED, frames=400, held_out_frames=100, probe_steps=200)
    monkeypatch.setattr(training, "OFFERED", few)


def test_all_are_listed_and_named_in_results(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    said = capsys.readouterr().out
    for name in ("tiles", "their_study", "their_data", "their_regressor"):
        assert name in said
    assert "as study smoke, a name that is taken" in said and "and no EncoderEntry; mend" in said
    assert versions()["their_things"].startswith("1.2+")


@pytest.mark.parametrize("agent", ["dqn", pytest.param("imagination", marks=pytest.mark.slow)])
def test_an_own_representation_trains_an_agent(tmp_path: Path, capsys: pytest.CaptureFixture[str], agent: str) -> None:
    few = {"budgets": (2,), "evaluation_episodes": 2, "open_loop_starts": 2, "encoder": "tiles"}
    first, second = (benched(tmp_path / place, "arrow_puzzle", agent, **few) for place in ("first", "second"))
    assert capsys.readouterr().out.count("The scale and the probe of tiles for arrow_puzzle at clean are made") == 1
    assert second.protocol == first.protocol, "found again"
    assert str(first.protocol.encoder).startswith("tiles-arrow_puzzle-clean@")
    (run,) = first.runs
    assert (run.checkpoints[0].open_loop is None) == (agent == "dqn")
    path = load_trained(run.folder).spec.encoder
    assert path is not None
    elsewhere = replace(first.protocol, test_appearance="strong")
    assert encoder_of_run(elsewhere, agent, "tiles") == path, "the one of the appearance in training"
    encoder, spec = Encoder.load(path), registry.task("arrow_puzzle")
    states = np.array(spec.rules.states[:50])
    frames = spec.render_macrostates(states, "clean", np.random.default_rng(1))
    mu, sigma = encoder.encode(frames)
    assert mu.shape == (50, 48) and float(sigma.max()) < 1e-3 and float(mu.abs().median()) < 3.0
    expected = frames.reshape(50, 4, 16, 4, 16, 3).mean(axis=(2, 4)) / 255.0
    assert np.abs(encoder.decode(mu)[:, ::16, ::16] - expected).max() < 0.01
    far = encoder.decode(100.0 * mu)
    assert (far.min(), far.max()) == (0.0, 1.0), "images of latents that were never seen are cut off"
    right = (encoder.read_macrostate(mu) == states).all(axis=1).mean()
    assert right > 0.2 > 4 / len(spec.rules.states)


def test_codes_of_theirs_stay_as_they_are() -> None:
    """Only latents are brought to one scale."""
    path = encoders.resolve(registry.task("arrow_puzzle"), "clean", "corners")
    card = Encoder.load(path).card
    assert (encoders.kind(path), card.code_sizes, card.latent_size) == ("codes", (2, 2), 4)
    assert card.command == "imagine-bench bench --task arrow_puzzle --appearance clean --encoder corners"
    assert card.data.startswith("those of their_things:Corners, 400 and 100 held-out frames")
    frames = np.zeros((4, 64, 64, 3), np.uint8)
    for number, frame in enumerate(frames):
        frame[:32, :32], frame[:32, 32:] = 9 * (number % 2), 9 * (number // 2)
    codes = Encoder.load(path).encode(frames)[0].tolist()
    assert codes == [[1, 0, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1], [0, 1, 0, 1]]


def test_one_without_a_decoder_draws_gray() -> None:
    theirs = importlib.import_module("their_things")
    path = encoders.resolve(registry.task("arrow_puzzle"), "mild", "tiles")
    del theirs.Tiles.decode
    encoder = Encoder.load(path)
    assert encoder.card.appearance == "mild"
    pictures = encoder.decode(encoder.encode(np.zeros((2, 64, 64, 3), np.uint8))[0])
    assert pictures.shape == (2, 64, 64) and (pictures == 0.5).all()
    del theirs.Tiles
    with pytest.raises(ArtefactError, match="has no attribute 'Tiles'"):
        Encoder.load(path)


def test_one_that_is_none_is_refused_in_a_sentence() -> None:
    sentence = r"blind \(their_things:Blind\) failed: .* 8 frames have latents of shape \(8, 3\); it mu"
    with pytest.raises(InvalidValueError, match=sentence):
        plan("arrow_puzzle", "smoke", agents=("dqn",), encoder="blind")


def test_a_study_of_theirs_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["sweep", "arrow_puzzle", "--name", "their_study", "--variants", "none", "--out", str(tmp_path)]
    assert main(words) == 2
    assert "No variant 'none'" in capsys.readouterr().err
    assert registry.offered("their_study", {}, registry.STUDY_GROUP).question == "Whose?"


def test_their_model_of_motions_is_judged_as_the_suites_own_are() -> None:
    assert {"their_motion_model", "no_change", "recurrent"} <= set(motion_models())
    assert motion_model_entry("their_motion_model").make == "their_things:Tiles"
    with pytest.raises(SetupError, match=r"as model of motions no_entry, which is .* and no MotionModelEntry; mend"):
        motion_model_entry("no_entry")


def test_their_regressor_learns_their_data(tmp_path: Path) -> None:
    tiny = (("components", 3), ("epochs", 2), ("hidden", [8, 8]), ("weight_samples", 3))
    wanted, none = plan("their_data", "smoke", agents=("their_regressor",), test_points=10, overrides=tiny)
    found = run(RunSpec(protocol=wanted, agent="their_regressor", seed=0), tmp_path, lambda progress: None)
    assert not none and {row["variant"] for row in found.rows} == {"base"}
    with pytest.raises(InvalidValueError, match="their_plain_regressor names no settings; leave components, "):
        plan("their_data", "smoke", agents=("their_plain_regressor",), overrides=tiny)
    assert plan("their_data", "smoke", agents=("their_plain_regressor",))[0].agents == ("their_plain_regressor",)
