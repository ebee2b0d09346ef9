"""A plain world model without a network, between *copy* and the networks: an engineer's work of one afternoon.

Pixels that change under the same macro-actions are a patch. The appearances of each patch are grouped. A table counts
which appearance follows which under each macro-action, another which rewards and ends came with the appearances. Frames
are drawn by pasting an example of the new appearance into the latest frame.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Hashable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.cluster import hierarchy
from scipy.ndimage import uniform_filter
from scipy.spatial.distance import squareform

from imagine_bench.arrays import Floats, Frame, Ints, Pixels
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.episodes import Episodes
from imagine_bench.interfaces.model import Imagined, until_the_end

_CHANGED = 40  # a pixel has changed if one of its colors differs by more, of 255
_OFTEN = 0.1  # share of the transitions of a macro-action in which it changes the pixels of a patch
_LEAST_PIXELS = 40  # of a patch
_MOST_APPEARANCES = 32  # of a patch
_COMPARED = 300  # frames whose appearances are grouped
_BLUR = 3  # pixels
_SHIFT = 2  # pixels by which two frames with the same appearance may be shifted
_LEVEL = 0.02  # of the largest distance: differences below it count as none
Appearances = tuple[int, ...]
"""The appearance of each patch, by its number."""
Memory = defaultdict[Hashable, list[int]]
"""A table of one patch: the appearances before and a macro-action, and a list of all appearances that followed them."""


class Patch(NamedTuple):
    """Pixels that change together, P of a flattened frame, and an example of each of their L appearances."""

    pixels: Ints  # shape (P,)
    gray: Floats  # shape (L, P)
    colors: Pixels  # shape (L, P, 3)

    def appearances(self, gray: Floats) -> Ints:
        """The appearance of each of N gray frames (N, 4096). Shape (N,)."""
        return _distances(gray, self.pixels, self.gray).argmin(axis=1)


class Patches:
    """Patches, appearances and tables as a world model."""

    def __init__(self, context: AgentContext) -> None:
        self.n_actions = context.n_actions
        self.patches: list[Patch] = []
        self.tables: list[Memory] = []
        self.outcomes: defaultdict[Hashable, list[tuple[float, bool]]] = defaultdict(list)
        """Rewards and ends that were seen: with the appearances before and after a macro-action, and with those
        after.
        """

    def fit(self, dataset: Episodes, rng: np.random.Generator) -> None:
        """Find patches and appearances, and count."""
        frames = dataset.frames
        before = dataset.rows[0]
        gray = _gray(frames)
        some = np.sort(rng.choice(len(frames), min(_COMPARED, len(frames)), replace=False))
        groups = _pixels_of_patches(frames, before, dataset.actions, self.n_actions)
        self.patches = [_patch(frames[some], gray[some], pixels) for pixels in groups]
        appearances = self._appearances(gray)
        actions = dataset.actions.tolist()
        rows = zip(before.tolist(), actions, strict=True)
        steps = [(appearances[row], action, appearances[row + 1]) for row, action in rows]
        self.tables = [_table(steps, index) for index in range(len(self.patches))]
        ends = zip(dataset.rewards.tolist(), dataset.terminated.tolist(), strict=True)
        for step, outcome in zip(steps, ends, strict=True):
            for key in (step, step[2], None):
                self.outcomes[key].append(outcome)

    def _appearances(self, gray: Floats) -> list[Appearances]:
        """The appearances of N gray frames."""
        found = np.zeros((len(gray), len(self.patches)), dtype=np.int64)
        for index, patch in enumerate(self.patches):
            found[:, index] = patch.appearances(gray)
        return list(map(tuple, found.tolist()))

    def imagine(self, frames: Frame, actions: Ints, samples: int, rng: np.random.Generator) -> Imagined:
        """Futures drawn from the table; see :class:`imagine_bench.interfaces.model.WorldModel`.

        ``epistemic`` is 1 / (1 + n) of the patch that the table knows least of, seen n times.
        """
        asked = actions[:, frames.shape[1] - 1 :]
        shape = (len(frames), samples, asked.shape[1])
        images = np.empty((*shape, *frames.shape[2:]), dtype=np.uint8)
        rewards, ends, unknown = np.zeros((3, *shape))
        starts = self._appearances(_gray(frames[:, -1]))
        for row, sample in np.ndindex(shape[:2]):
            appearances = starts[row]
            image = frames[row, -1].reshape(-1, 3).copy()
            for step, action in enumerate(asked[row].tolist()):
                after, seen = self._drawn(appearances, action, rng)
                place = (row, sample, step)
                rewards[place], ends[place] = self._outcome((appearances, action, after))
                unknown[place] = 1.0 / (1.0 + seen)
                for patch, old, new in zip(self.patches, appearances, after, strict=True):
                    if new != old:
                        image[patch.pixels] = patch.colors[new]
                images[place] = image.reshape(frames.shape[2:])
                appearances = after
        counted, p_ended = until_the_end(rewards, ends)
        return Imagined(pictures=images, rewards=counted, p_ended=p_ended, epistemic=unknown.mean(axis=1))

    def _drawn(self, appearances: Appearances, action: int, rng: np.random.Generator) -> tuple[Appearances, int]:
        """The next appearances, and how often that patch was seen of which least is known; unseen appearances stay."""
        after = list(appearances)
        least = len(self.outcomes[None])
        for index, table in enumerate(self.tables):
            seen = table.get((appearances, action)) or table.get((appearances[index], action), [])
            least = min(least, len(seen))
            if seen:
                after[index] = seen[int(rng.integers(len(seen)))]
        return tuple(after), least

    def _outcome(self, step: tuple[Appearances, int, Appearances]) -> tuple[float, float]:
        """Mean reward and share of ends of the step, else of its appearances after, else of everything."""
        seen = self.outcomes.get(step) or self.outcomes.get(step[2]) or self.outcomes[None]
        return math.fsum(reward for reward, _ in seen) / len(seen), sum(end for _, end in seen) / len(seen)

    def parameters(self) -> int:
        """Entries of the tables."""
        return sum(len(table) for table in self.tables) + len(self.outcomes)


def _gray(frames: Frame) -> Floats:
    """Frames (N, 64, 64, 3) in gray, a little blurred, flattened. Shape (N, 4096)."""
    blurred = uniform_filter(frames.mean(axis=3, dtype=np.float32), size=(0, _BLUR, _BLUR))
    return blurred.reshape(len(frames), -1)


def _distances(gray: Floats, pixels: Ints, examples: Floats) -> Floats:
    """Squared distances of gray frames (N, 4096) from examples (L, P), each shifted as fits best. Shape (N, L)."""
    by_pixel = np.ascontiguousarray(gray.T)
    squares = (examples**2).sum(axis=1)
    found = np.full((len(gray), len(examples)), np.inf)
    for down, right in itertools.product(range(-_SHIFT, _SHIFT + 1), repeat=2):
        shifted = by_pixel[np.clip(pixels + 64 * down + right, 0, len(by_pixel) - 1)]  # [P, N]
        away = (shifted**2).sum(axis=0)[:, None] - 2.0 * shifted.T @ examples.T + squares
        found = np.minimum(found, away)
    return np.maximum(found, 0.0)


def _pixels_of_patches(frames: Frame, before: Ints, actions: Ints, n_actions: int) -> list[Ints]:
    """Pixels that change under the same macro-actions; those that differ only between episodes are a patch, too."""
    taken = [before[actions == action] for action in range(n_actions)]
    rates = np.stack([_change_rates(frames, rows) for rows in taken], axis=1)  # [4096, A]
    differing = np.flatnonzero(np.ptp(frames, axis=0).max(axis=2) > _CHANGED)
    rates = rates[differing]
    _, kinds = np.unique(rates > _OFTEN, axis=0, return_inverse=True)
    large = np.flatnonzero(np.bincount(kinds) >= _LEAST_PIXELS)
    if not len(large):
        return [differing] if len(differing) else []
    typical = np.stack([rates[kinds == kind].mean(axis=0) for kind in large])
    nearest = ((rates[:, None] - typical) ** 2).sum(axis=2).argmin(axis=1)  # a small group joins a large one
    return [differing[nearest == index] for index in range(len(large))]


def _change_rates(frames: Frame, rows: Ints) -> Floats:
    """Share of the transitions from these frames in which each pixel changes; 0 of none. Shape (4096,)."""
    away = np.abs(frames[rows + 1].astype(np.int16) - frames[rows]).max(axis=3)
    rates: Floats = (away > _CHANGED).sum(axis=0).ravel() / max(1, len(rows))
    return rates


def _patch(frames: Frame, gray: Floats, pixels: Ints) -> Patch:
    """A patch, whose appearances are groups by average distance; their number is where distances rise most steeply."""
    seen = gray[:, pixels]
    squared = _distances(gray, pixels, seen)
    away = np.sqrt(np.maximum(squared, squared.T))
    np.fill_diagonal(away, 0.0)
    tree = hierarchy.linkage(squareform(away, checks=False), "average")
    heights = tree[::-1, 2][:_MOST_APPEARANCES]  # at which 2, 3, ... groups become one fewer
    rises = heights[:-1] / (heights[1:] + _LEVEL * max(heights[0], 1.0))
    count = 2 + int(rises.argmax()) if len(rises) else 2
    group = hierarchy.fcluster(tree, count, "maxclust")
    members = [np.flatnonzero(group == each) for each in np.unique(group)]
    middle = [rows[away[np.ix_(rows, rows)].sum(axis=1).argmin()] for rows in members]
    return Patch(pixels, seen[middle], frames[middle].reshape(len(middle), -1, 3)[:, pixels])


def _table(steps: Sequence[tuple[Appearances, int, Appearances]], index: int) -> Memory:
    """The appearances that followed a patch's own and, if these predict it better, those of all patches."""
    own: Memory = defaultdict(list)
    whole: Memory = defaultdict(list)
    for before, action, after in steps:
        own[before[index], action].append(after[index])
        whole[before, action].append(after[index])
    if _foretold(whole) > _foretold(own):
        own.update(whole)
    return own


def _foretold(table: Memory) -> float:
    """Log-likelihood of the appearances that followed, each predicted from all others in its list."""
    found = 0.0
    for seen in table.values():
        for count in Counter(seen).values():
            found += count * math.log((count - 0.5) / len(seen))
    return found
