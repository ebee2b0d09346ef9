"""Filmstrips of imagined rollouts: beside reality, or several of one start below one another (thesis' figure 3.4)."""

from __future__ import annotations

import functools
import io
import textwrap
from collections.abc import Sequence
from importlib import resources
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from imagine_bench.arrays import Pixels
from imagine_bench.interfaces import Macrostate, Rules, TaskSpec
from imagine_bench.rules import states_of
from imagine_bench.store.results import ComparedRollout, RecordedEpisode

CELL_PX = 128  # a 64-pixel frame at 2x, nearest, so that no pixel is made up
STEP_PX = 144  # from column to column
LABELS_PX = 108  # width of the column that names the rows
TITLE_PX = 52  # three lines above a row's images
_LINE_PX = 17
_BORDER_PX = 3
_LETTERS = 18  # of a line
_BLANK_PX = 14
INK = (28, 30, 34)
PAPER = (255, 255, 255)
RIGHT = (0, 114, 178)  # Okabe-Ito blue and vermilion: color-blind safe
WRONG = (213, 94, 0)
CUT = (204, 30, 90)
_Rgb = tuple[int, int, int]


class SheetColors(NamedTuple):
    """Colors of a sheet: its paper, its words, right and wrong images, and the cut of the filter."""

    paper: _Rgb = PAPER
    ink: _Rgb = INK
    right: _Rgb = RIGHT
    wrong: _Rgb = WRONG
    cut: _Rgb = CUT


LIGHT = SheetColors()
DARK = SheetColors((13, 16, 17), (222, 224, 228), (86, 180, 233), (255, 140, 60), (255, 80, 150))
"""For a report's white page, and for a viewer's dark one."""
TileRow = tuple[str, Sequence[Pixels] | Pixels, Sequence[bool] | None]
"""The name of a row of images, the images, and whether each is right; None where that is no question."""


class Tile(NamedTuple):
    """An image of a sheet with the words above and below it."""

    frame: Pixels | None  # RGB bytes of a square image; None leaves its place empty
    above: str = ""
    below: str = ""  # its lines, in the color of the border where there is one
    right: bool | None = None  # a border: blue where True, orange where False
    pale: bool = False  # it is not counted
    cut: bool = False  # the uncertainty filter cuts before it, which a line marks


def sheet(
    rows: Sequence[tuple[str, Sequence[Tile]]], columns: int | None = None, colors: SheetColors = LIGHT
) -> Pixels:
    """Draw named rows of images below one another, with room for so many ``columns``, None for all.

    The image has shape (height, width, 3), uint8.
    """
    room = max(len(tiles) for _, tiles in rows) if columns is None else columns
    return np.concatenate([_row(name, tiles[:room], LABELS_PX + room * STEP_PX, colors) for name, tiles in rows])


def _row(name: str, tiles: Sequence[Tile], width: int, colors: SheetColors) -> Pixels:
    top = TITLE_PX if any(tile.above for tile in tiles) else _BORDER_PX
    bottom = top + CELL_PX
    lines = max(tile.below.count("\n") + bool(tile.below) for tile in tiles)
    canvas = Image.new("RGB", (width, bottom + _LINE_PX * lines + _BLANK_PX), colors.paper)
    draw = ImageDraw.Draw(canvas)
    draw.multiline_text((4, top + 40), textwrap.fill(name, 13), colors.ink, font(bold=True))
    for column, tile in enumerate(tiles):
        left = LABELS_PX + column * STEP_PX
        title = "\n".join(textwrap.wrap(tile.above, _LETTERS)[:3])
        draw.multiline_text((left, 4), title, colors.ink, font(bold=True), spacing=2)
        color = colors.ink
        if tile.right is not None:
            color = colors.right if tile.right else colors.wrong
            edge = (left - _BORDER_PX, top - _BORDER_PX, left + CELL_PX + 2, bottom + 2)
            draw.rectangle(edge, outline=color, width=_BORDER_PX)
        if tile.frame is not None:
            image = Image.fromarray(tile.frame).convert("RGB").resize((CELL_PX, CELL_PX), Image.Resampling.NEAREST)
            paper = Image.new("RGB", image.size, colors.paper)
            canvas.paste(Image.blend(image, paper, 0.65 * tile.pale), (left, top))
        if tile.cut:
            draw.line([(left - 9, 0), (left - 9, canvas.height)], colors.cut, 3)
        draw.multiline_text((left, bottom + 4), tile.below, color, font(), spacing=3)
    return np.asarray(canvas)


def episode_strip(episode: RecordedEpisode, action_names: Sequence[str], columns: int = 4) -> Pixels:
    """Draw the frames of an episode, ``columns`` in a row, each with the macro-action that led to it and its reward.

    The last frame has a border, blue where the episode was solved and orange where not, and says below how it ended.
    The image has shape (height, width, 3), uint8.
    """
    tiles = [Tile(episode.frames[0], "start")]
    steps = zip(episode.frames[1:], episode.actions.tolist(), episode.rewards.tolist(), strict=True)
    for step, (frame, action, reward) in enumerate(steps, 1):
        tiles.append(Tile(frame, f"{step}. {action_names[action]}", f"reward {signed(reward)}"))
    words = textwrap.fill(str(episode.end), _LETTERS)
    tiles[-1] = tiles[-1]._replace(below=f"{tiles[-1].below}\n{words}", right=bool(episode.success))
    rows = [tiles[first : first + columns] for first in range(0, len(tiles), columns)]
    return sheet([("" if index else "real frames", row) for index, row in enumerate(rows)], columns)


def filmstrip(
    compared: ComparedRollout, action_names: tuple[str, ...], *, columns: int | None = None, colors: SheetColors = LIGHT
) -> Pixels:
    """Draw one imagined rollout below reality, one column a macro-action.

    Each column names the macro-action and shows the real frame, the decoded imagined one, and the predicted reward,
    P(end) and epistemic uncertainty, with the true reward in brackets. A vertical line marks where the uncertainty
    filter cuts; discarded images are paler. The border of an imagined frame is blue where its macrostate follows from
    the rules and orange where it does not; the text below says the same. Where nothing real is to compare with (a plan
    that was not carried out that far), the upper row stays empty. There is room for ``columns`` macro-actions, None for
    all. The image has shape (height, width, 3), uint8.
    """
    rollout = compared.rollout
    done = len(compared.real_frames)
    real = [Tile(compared.start_frame, "start")]
    imagined = [Tile(rgb(rollout.start_frame), below="\npredicted\n(true)")]
    for index, action in enumerate(rollout.actions.tolist()):
        over = 0 < index <= done and bool(compared.real_terminated[index - 1])
        kept = bool(rollout.accepted[index])
        cut = not kept and bool(rollout.accepted[:index].all())
        frame = None
        right = None
        truth = ""
        if index < done:
            frame = compared.real_frames[index]
            truth = f" ({compared.real_rewards[index]:+.1f})"
            right = None if over else np.array_equal(rollout.macrostates[index], compared.real_macrostates[index])
        lines = (
            "episode over" if over else _verdict(right),
            f"reward {rollout.rewards[index]:+.1f}{truth}",
            f"P(end) {rollout.p_terminated[index]:.2f}",
            f"epistemic {rollout.epistemic[index]:.2g}",
            "filter cuts here" if cut else "",
        )
        real.append(Tile(frame, f"{index + 1}. {action_names[action]}", pale=over, cut=cut))
        imagined.append(Tile(rgb(rollout.frames[index]), "", "\n".join(lines), right, not kept, cut))
    return sheet([("real", real), ("imagined", imagined)], None if columns is None else 1 + columns, colors)


def sampled_filmstrips(
    sampled_rollouts: tuple[ComparedRollout, ...], spec: TaskSpec, colors: SheetColors = LIGHT
) -> Pixels:
    """Draw imagined rollouts of one start below one another, a column a macro-action; only the start is real.

    Below each imagined frame stands the change that a probe reads: in blue where the rules make it possible, in
    orange where not, in black where frames hide or delay a part, so that single steps cannot be judged. The image has
    shape (height, width, 3), uint8.
    """
    rows: list[tuple[str, list[Tile]]] = []
    for compared in sampled_rollouts:
        rollout = compared.rollout
        before = compared.start_macrostate
        tiles = [Tile(None) if rows else Tile(compared.start_frame)]
        for step, now in enumerate(rollout.macrostates):
            action = int(rollout.actions[step])
            end = "; the end" if rollout.p_terminated[step] > 0.5 else ""
            words = textwrap.fill(changes(before, now, spec) + end, _LETTERS)
            right = is_possible(spec.rules, before, action, now) if spec.sight is None else None
            tiles.append(Tile(rgb(rollout.frames[step]), spec.action_names[action], words, right))
            before = now
        rows.append(("the same start, imagined again" if rows else "the real start", tiles))
    return sheet(rows, colors=colors)


def transition_sheet(titles: Sequence[str], rows: Sequence[TileRow]) -> Pixels:
    """Draw single transitions side by side (thesis' figure 5.9): a title each, below it an image of
    each named row.

    Images are square, RGB or gray bytes. A row that is judged has a border around each image, blue where it is right
    and orange where not, and says it below. The image has shape (height, width, 3), uint8.
    """
    drawn: list[tuple[str, list[Tile]]] = []
    for name, images, judged in rows:
        rights: Sequence[bool | None] = judged or [None] * len(images)
        above = [""] * len(images) if drawn else titles
        marked = zip(images, above, rights, strict=True)
        drawn.append((name, [Tile(image, title, _verdict(right), right) for image, title, right in marked]))
    return sheet(drawn)


def signed(reward: float) -> str:
    """A reward with its sign and at most two decimals, those that are not 0: ``+50``, ``-0.5``, ``-1.23``."""
    return f"{reward:+.2f}".rstrip("0").rstrip(".")


def _verdict(right: bool | None) -> str:
    if right is None:
        return ""
    return "as the rules say" if right else "not as the rules say"


def png(image: Pixels) -> bytes:
    """Encode an image (height, width, 3), uint8, as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def rgb(image: NDArray[np.float32]) -> Pixels:
    """An image in [0, 1], gray (H, W) or RGB (H, W, 3), as RGB bytes (H, W, 3)."""
    pixels = (np.clip(image, 0.0, 1.0) * 255.0).round().astype(np.uint8)
    return np.asarray(Image.fromarray(pixels).convert("RGB"))


def changes(before: Macrostate, now: Macrostate, spec: TaskSpec) -> str:
    """The differences, in the task's own words."""
    named = zip(spec.macrostate_names, spec.value_names(now), before, now, strict=True)
    return ", ".join(f"{name} {value}" for name, value, was, after in named if was != after) or "nothing changes"


def is_possible(rules: Rules, before: Macrostate, action: int, now: Macrostate) -> bool:
    """Whether the rules allow ``now`` after ``action`` in ``before``."""
    state = tuple(before.tolist())
    reached = tuple(now.tolist())
    known = state in states_of(rules) and not rules.is_terminal(state)
    return known and any(outcome.macrostate == reached for outcome in rules.outcomes(state, action))


@functools.lru_cache
def font(*, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu Sans, which travels with matplotlib."""
    file = resources.files("matplotlib") / f"mpl-data/fonts/ttf/DejaVuSans{'-Bold' if bold else ''}.ttf"
    return ImageFont.truetype(io.BytesIO(file.read_bytes()), 12)
