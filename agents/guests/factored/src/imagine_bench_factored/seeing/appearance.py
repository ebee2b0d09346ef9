"""Factors and values found in the agent's own frames, told by interaction; no label, and no frame but its own.

*Where*: pixels that change from one frame to the next, again and again, and hang together are one factor. *Values*: two
crops of a factor are alike if the brightness gradients of one, shifted by a few pixels, are those of the other; values
are groups of crops (average linkage) below the widest gap among the heights at which groups merge, or below the next
one if that predicts the outcome of an action much better. Tints, brightness and the jitter of a pose change neither. A
crop that is like no exemplar of its factor has no known value.

Where hardly a look is seen twice there is noise: of each pixel only colors that are usual or stay are seen, so that an
    object in front of noise is a factor as any.

Sources: frame differences as motion segments (Jain & Nagel 1979); a few usual colors a pixel (Stauffer & Grimson 1999);
states split where that predicts better (McCallum 1996); a table's marginal likelihood (Cooper & Herskovits 1992);
normalised cross-correlation of gradients (Lewis 1995; Scharstein 1994); average linkage (Sokal & Michener 1958).
Shapes: ``N`` frames, ``P`` factors, ``D`` numbers of a crop.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from imagine_bench.arrays import Floats, Floats32, Frame, Ints

from ..factors import Codes, Mask

Images = Floats32

SHIFT_PX = 5
"""Crops are compared at all shifts of so many pixels up, down, left and right."""
_CHANGE = 0.3  # of the median brightness: a pixel that changes by less shows no change
_CHANGES = (2, 0.03)  # times, and share of the steps, that a pixel must change to belong to a factor
_STARTS = (3, 0.2)  # the same of the starts of episodes: factors that no action changes may change there alone
_ENOUGH = 500  # steps that a share is taken of at most: the more things there are, the more rarely each changes
_LEAST_PX = 36  # pixels of a factor
_LEAST_INNER_PX = (
    16  # the same of a component that lies all in the inner of the image: at its border, slivers come into view
)
_FLAT = 0.1  # of a crop's energy, as most have it: the value of a crop without contours
_SAME = 0.15  # distance that jitter makes; the least distance of two values
_OTHER = 0.2
_ROUND = 0.05  # added to heights where gaps are compared by their ratio
_EVIDENCE = 10.0  # how much more likely, as a logarithm, finer values must make the next values
_DIGITS = 9  # of that logarithm, behind the point, that are no rounding
_EXEMPLARS = 6  # most crops a value that are kept
_COMPARED = 160  # most crops a factor that are grouped; the others take the value of the most alike
_TOGETHER = 0.45  # share of the changes of either of two neighbouring pixels of a region that are changes of both
_TOLD = 8  # times that either of two pixels must change in half of the time for that half to tell
_TELLING = 20  # in so many frames, the share of looks seen once beyond which a region is noise
_NOISE = 0.5
_FREQUENT = 0.25  # share of the frames in which a pixel shows a color that is no noise; most such colors
_COLORS = 8
_RESTS = 0.1  # the same of a color that stays
_STAYS = 0.2  # how much likelier such a color is where it was a step before: 0 as chance has it, 1 for sure
_MEDIAN_COLOR = 1.0  # the color of a pixel in place of noise: the median
_SEEN = 3  # times that a value must have been seen to tell whether it varies freely
_MOST = 0.7  # share of the pixels that hang together
_EXPECTED = 5.0  # times that joint values that were never seen would have been seen by chance
_ALL = slice(None)
_NEXT = slice(1, None)
_LAST = slice(None, -1)
_NEIGHBOURS = (
    ((_ALL, _LAST), (_ALL, _NEXT)), ((_LAST, _ALL), (_NEXT, _ALL)),
    ((_LAST, _LAST), (_NEXT, _NEXT)), ((_LAST, _NEXT), (_NEXT, _LAST)),
)  # fmt: skip
"""Pairs of neighbouring pixels: to the right, below, and both diagonals."""
_COMPACT = 0.5  # share of a thing's pixels that are no thin rim
_INNER = (slice(2, -2), slice(2, -2))  # rows and columns that are not the border's
_DARK = 2.5  # of 255
_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


class SeenValues(NamedTuple):
    """The values that N frames show, of one factor, (N,), or of P, (N, P)."""

    values: Ints
    known: Mask  #: whether such a value was seen before
    #: False where a part of the region is hidden and an exemplar of another value is nearer than jitter makes two
    #: crops of one value; of a factor, where that is so in any of its parts.
    clear: Mask


class Part(NamedTuple):
    """One region, and crops of which each shows a value."""

    mask: Mask  #: its pixels. Shape (64, 64).
    exemplars: Images  #: crops. Shape (E, D).
    values: Ints  #: the content of each. Shape (E,).
    flat: float  #: energy that crops without contours count as
    reach: float  #: distance beyond which a crop is like no exemplar
    #: where it is in front of noise, the values that :func:`quiet` needs. Shape (K, 64, 64, 3).
    rests: Images | None = None

    def read(self, shapes: Images) -> SeenValues:
        """The value that each of N frames' contours shows."""
        own = crops(shapes, self.mask)
        apart = distances(own, self.exemplars, self.mask, self.flat)
        values = self.values[apart.argmin(axis=1)]
        of_others = np.where(self.values == values[:, None], np.inf, apart).min(axis=1)
        clear = (of_others >= _SAME) | ~np.isnan(own).any(axis=1)
        return SeenValues(values, apart.min(axis=1) <= self.reach, clear)


class SeenFactor(NamedTuple):
    """One factor: regions that do not vary freely, and the joint values that were seen. Shape (K, parts)."""

    parts: tuple[Part, ...]
    joint: Codes

    def read(self, shapes: Images, still: Images) -> SeenValues:
        """As of a part, ``still``: without noise; of joint values not seen the one that differs in the fewest parts."""
        found = _stacked([part.read(shapes if part.rests is None else still) for part in self.parts])
        wrong = (found.values[:, None] != self.joint).sum(axis=2)  # [N, K]
        known = found.known.all(axis=1) & (wrong.min(axis=1) == 0)
        return SeenValues(wrong.argmin(axis=1), known, np.asarray(found.clear.all(axis=1)))


def _stacked(readings: Sequence[SeenValues]) -> SeenValues:
    """Readings (N,) of several as one, (N, P)."""
    return SeenValues(*(np.stack(column, axis=1) for column in zip(*readings, strict=True)))


def read(factors: list[SeenFactor], frames: Frame | Images) -> SeenValues:
    """The values of P factors that frames (N, 64, 64, 3) show, (N, P)."""
    images = relative(frames)
    shapes = contours(images)
    rests = next((part.rests for factor in factors for part in factor.parts if part.rests is not None), None)
    still = shapes if rests is None else contours(quiet(images, rests))
    return _stacked([factor.read(shapes, still) for factor in factors])


def find(frames: Frame | Images, begins: Mask | None = None, actions: Ints | None = None) -> list[SeenFactor]:
    """The factors of frames (N, 64, 64, 3) in the order in which they were seen; none where nothing changes.

    ``begins``: which are the first of an episode, (N,); none if not given. ``actions``: which led from each frame to
    the next, (N,), negative where none did; unknown if not given.
    """
    images = relative(frames)
    shapes = contours(images)
    begins = np.zeros(len(frames), dtype=bool) if begins is None else begins
    actions = np.full(len(frames), -1) if actions is None else actions
    factors = [SeenFactor((part,), values[:, None]) for part, values in _parts(images, shapes, begins, actions)]
    while (pair := _first_bound([factor.joint for factor in factors])) is not None:
        other = factors.pop(pair[1])
        one = factors[pair[0]]
        joint = np.concatenate([one.joint, other.joint], axis=1)
        factors[pair[0]] = SeenFactor((*one.parts, *other.parts), joint)
    return [factor._replace(joint=np.unique(factor.joint, axis=0)) for factor in factors]


def _parts(images: Images, shapes: Images, begins: Mask, actions: Ints) -> list[tuple[Part, Ints]]:
    """Regions that have values, and those (N,); where hardly a look is seen twice, those that hide the noise."""
    change = changes(images)
    often = _often(change, begins)
    found = [(mask, *_part(shapes, mask, actions)) for mask in regions(change, often)]
    noise = np.any([mask & (singles > _NOISE) for mask, _, singles in found] or [often & False], axis=0)
    noise = scipy.ndimage.binary_propagation(noise, np.ones((3, 3)), often)  # all that hangs together with it, too
    seen = [part for mask, part, _ in found if part is not None and not (mask & noise).any()]
    parts = [(part, part.read(shapes).values) for part in seen]
    if noise.any():
        rests = _resting(images, change, noise)
        still = quiet(images, rests)
        change = changes(still)
        shapes = contours(still)
        hiding = [_part(shapes, mask, actions) for mask in regions(change, noise & _often(change, begins))]
        seen = [part._replace(rests=rests) for part, singles in hiding if part is not None and singles <= _NOISE]
        parts += [(part, part.read(shapes).values) for part in seen]
    return parts


def _often(change: Mask, begins: Mask) -> Mask:
    """Pixels (64, 64) that change in enough of the steps (N - 1, 64, 64), or of those to the first of an episode."""
    of = ((change, _CHANGES), (change[begins[1:]], _STARTS))
    enough = [max(least, share * min(len(steps), _ENOUGH)) for steps, (least, share) in of]
    return np.any([steps.sum(axis=0) >= few for (steps, _), few in zip(of, enough, strict=True)], axis=0)


def _resting(images: Images, change: Mask, noise: Mask) -> Images:
    """Colors that each pixel of ``noise`` (64, 64) shows often, and then mostly for a while; see :func:`quiet`."""
    colors = images[:-1, noise]  # [N - 1, pixels, 3], [N - 1, pixels]
    left = ~change[:, noise]
    rests = np.full((_COLORS, *images.shape[1:]), np.nan, dtype=np.float32)
    for each in rests:
        one = np.take_along_axis(colors, left.argmax(axis=0)[None, :, None], axis=0)
        like = (np.abs(colors - one) <= _CHANGE).all(axis=-1)
        share = like.mean(axis=0)
        again = (like[1:] & like[:-1]).sum(axis=0) / np.maximum(like[:-1].sum(axis=0), 1)
        kept = (share >= _FREQUENT) | (share >= _RESTS) & (again >= share + _STAYS * (1.0 - share))
        each[noise] = np.where(kept[:, None], one[0], np.inf)
        left &= ~like
    return rests


def quiet(images: Images, rests: Images) -> Images:
    """Images (N, 64, 64, 3) with nothing in place of noise.

    ``rests``: colors (K, 64, 64, 3) that a pixel may keep, infinite where it has fewer, no numbers beside the noise.
    """
    noise = ~np.isnan(rests[0, ..., 0])
    colors = images[:, noise]
    shown = np.ones(images.shape[:3], dtype=bool)
    shown[:, noise] = np.any([(np.abs(colors - one[noise]) <= _CHANGE).all(axis=-1) for one in rests], axis=0)
    shown |= scipy.ndimage.binary_closing(shown, np.ones((1, 3, 3)))
    return np.where(shown[..., None] | np.isnan(images), images, np.float32(_MEDIAN_COLOR))


def _first_bound(joint: list[Codes]) -> tuple[int, int] | None:
    """The first two factors, by their joint values (N, parts), that do not vary freely, or None."""
    values = [np.unique(each, axis=0, return_inverse=True)[1].ravel() for each in joint]
    pairs = itertools.combinations(range(len(values)), 2)
    return next(((one, other) for one, other in pairs if bound(values[one], values[other])), None)


def bound(one: Ints, other: Ints) -> bool:
    """Whether two factors (N,) have no more joint values than one of them could have had alone or in turns.

    So have a factor and a copy of it, and things of which one excludes the other; unless chance may explain it.
    """
    table = np.zeros((one.max() + 1, other.max() + 1))
    np.add.at(table, (one, other), 1.0)
    table = table[table.sum(axis=1) >= _SEEN][:, table.sum(axis=0) >= _SEEN]
    if min(table.shape) < 2 or not table.any():
        return False
    expected = np.multiply.outer(table.sum(axis=1), table.sum(axis=0)) / table.sum()
    few = (table > 0).sum() < sum(table.shape)
    return bool(few and expected[table == 0].sum() >= _EXPECTED)


def relative(frames: Frame | Images) -> Images:
    """Frames in units of the median of each color, slightly blurred. Shape (N, 64, 64, 3).

    Pixels that are hidden, and those beside them, are no numbers.
    """
    images = frames.astype(np.float32)
    median = np.nanmedian if np.isnan(images).any() else np.median
    images /= np.maximum(median(images.reshape(len(images), -1, 3), axis=1), _DARK)[:, None, None]
    for axis in (1, 2):
        images = scipy.ndimage.convolve1d(images, np.array([0.25, 0.5, 0.25], np.float32), axis, mode="nearest")
    return images


def contours(images: Images) -> Images:
    """Gradients of the logarithm of brightness, down and to the right. (N, 64, 64, 3) to (N, 64, 64, 2)."""
    log = np.log(np.maximum(images @ _LUMA, 0.1))
    return np.stack([np.gradient(log, axis=1), np.gradient(log, axis=2)], axis=-1)


def _beyond(one: Images, other: Images) -> Images:
    """How far ``other`` lies outside of the pixels that ``one`` shows there and one pixel around."""
    around = (1, 3, 3, 1)
    low = scipy.ndimage.minimum_filter(one, around)
    high = scipy.ndimage.maximum_filter(one, around)
    return np.maximum(np.maximum(other - high, low - other), 0.0)


def changes(images: Images) -> Mask:
    """Where one of two successive images (N, 64, 64, 3) shows a contour that the other does not show within a pixel.

    Small holes are closed. Shape (N - 1, 64, 64).
    """
    hidden = np.isnan(images[..., 0])
    images = np.nan_to_num(images)
    before = images[:-1]
    after = images[1:]
    change = np.maximum(_beyond(before, after), _beyond(after, before)).max(axis=-1) > _CHANGE
    if hidden.any():
        hidden = scipy.ndimage.binary_dilation(hidden, np.ones((1, 3, 3)))
        change &= ~(hidden[:-1] | hidden[1:])
    change = np.pad(change, ((0, 0), (2, 2), (2, 2)))
    return scipy.ndimage.binary_closing(change, np.ones((1, 3, 3)))[:, 2:-2, 2:-2]


def regions(change: Mask, pixels: Mask) -> list[Mask]:
    """Regions (64, 64) of ``pixels``, of which each changes at the same times (N, 64, 64), the largest first.

    A pixel belongs to the region of a neighbour if both change together: in a share of the times when either does, and
    in each half of the time, too, where it tells. Else a habit of the agent, kept for a while, would bind two things.
    Pixels that hang together, up to two pixels apart, are parted so only if most of them are in a region then; else
    they are one. A remaining connected region that is not a thin border is a small object touching a large one.
    """
    place = np.cumsum(pixels).reshape(pixels.shape) - 1
    change = change[:, pixels].astype(np.float32)  # [N - 1, pixels]
    spans = (change, *np.array_split(change, 2))
    told = np.array([[0], [_TOLD], [_TOLD]])
    links = []
    for one, other in _NEIGHBOURS:
        near = pixels[one] & pixels[other]
        rows = place[one][near]
        columns = place[other][near]
        both = np.stack([(span[:, rows] * span[:, columns]).sum(axis=0) for span in spans])
        either = np.stack([span[:, rows].sum(axis=0) + span[:, columns].sum(axis=0) for span in spans]) - both
        together = (both > _TOGETHER * either) | (either < told)
        links.append(np.stack([rows, columns])[:, together.all(axis=0)])
    every = np.concatenate(links, axis=1)
    graph = scipy.sparse.coo_matrix((np.ones(every.shape[1]), every), shape=(change.shape[1], change.shape[1]))
    label = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    pieces = np.full(pixels.shape, -1)
    pieces[pixels] = label
    large = np.flatnonzero(np.bincount(label) >= _LEAST_PX)
    found = []
    for mask in _hanging(pixels):
        inside = np.intersect1d(large, pieces[mask])
        parted = [pieces == piece for piece in inside]
        if sum(map(np.sum, parted)) < _MOST * mask.sum():
            found.append(mask)
        else:
            found += parted
            for rest in _hanging(mask & ~np.isin(pieces, inside)):
                thick = scipy.ndimage.binary_opening(rest, np.ones((2, 2))).sum()
                if rest.sum() >= _LEAST_PX and thick >= _COMPACT * rest.sum():
                    found.append(rest)
    least = [_LEAST_PX if mask[_INNER].sum() < mask.sum() else _LEAST_INNER_PX for mask in found]
    return sorted((mask for mask, few in zip(found, least, strict=True) if mask.sum() >= few), key=np.sum, reverse=True)


def _hanging(pixels: Mask) -> list[Mask]:
    """Groups of pixels (64, 64) that hang together, up to two pixels apart."""
    label, count = scipy.ndimage.label(scipy.ndimage.binary_dilation(pixels), np.ones((3, 3)))
    return [pixels & (label == index + 1) for index in range(count)]


def crops(shapes: Images, mask: Mask) -> Images:
    """The part of contours (N, 64, 64, 2) at and beside ``mask``, in the window around it. Shape (N, D)."""
    grown = scipy.ndimage.binary_dilation(mask)
    rows, columns = _window(mask)
    own = np.moveaxis(shapes[:, rows, columns] * grown[rows, columns, None], -1, 1)
    return own.reshape(len(shapes), -1)


def _window(mask: Mask) -> tuple[slice, slice]:
    """Rows and columns of a mask and the pixels beside it."""
    (top, bottom), (left, right) = (np.flatnonzero(mask.any(axis=axis))[[0, -1]] for axis in (1, 0))
    return slice(max(0, top - 1), bottom + 2), slice(max(0, left - 1), right + 2)


def distances(crop: Images, others: Images, mask: Mask, flat: float) -> Floats:
    """How unlike crops (N, D) and others (E, D) of one mask are: 1 - correlation at the best shift. Shape (N, E).

    Of crops, but not of the others, parts may be hidden: only the rest is compared.
    """
    hidden = np.isnan(crop).any(axis=1)
    if hidden.any():
        apart = np.empty((len(crop), len(others)))
        if not hidden.all():
            apart[~hidden] = distances(crop[~hidden], others, mask, flat)
        apart[hidden] = [_shown_distances(each, others, mask, flat) for each in crop[hidden]]
        return apart
    shifted = _shifted(crop, mask)
    best = np.stack([(each.reshape(-1, others.shape[1]) @ others.T).max(axis=0) for each in shifted])
    energy = np.sqrt(np.multiply.outer((crop**2).sum(axis=1) + flat, (others**2).sum(axis=1) + flat))
    return np.maximum(1.0 - (best + flat) / energy, 0.0).astype(np.float64)


def _shifted(crop: Images, mask: Mask) -> Images:
    """Crops (N, D) of one mask at all shifts, with zeros beyond their windows. Shape (N, S, S, 2, rows, columns)."""
    shape = mask[_window(mask)].shape
    margin = (SHIFT_PX, SHIFT_PX)
    image = np.pad(crop.reshape(len(crop), 2, *shape), ((0, 0), (0, 0), margin, margin))
    return np.lib.stride_tricks.sliding_window_view(image, shape, axis=(2, 3)).transpose(0, 2, 3, 1, 4, 5)


def _shown_distances(crop: Images, others: Images, mask: Mask, flat: float) -> Floats:
    """As :func:`distances`, of one crop (D,) of which a part is hidden. Shape (E,)."""
    size = others.shape[1]
    own = _shifted(np.nan_to_num(crop)[None], mask).reshape(-1, size)
    shown = 1.0 - _shifted(np.isnan(crop).astype(np.float32)[None], mask).reshape(-1, size)
    energy = (crop[~np.isnan(crop)] ** 2).sum() + flat
    of_others = shown @ (others**2).T + flat
    like = (own @ others.T + flat) / np.sqrt(energy * of_others)
    return np.asarray(np.maximum(1.0 - like.max(axis=0), 0.0), dtype=np.float64)


def _part(shapes: Images, mask: Mask, actions: Ints) -> tuple[Part | None, float]:
    """The part at a mask, None where all of its crops are alike; and the share of looks that were seen once."""
    own = crops(shapes, mask)
    whole = np.flatnonzero(~np.isnan(own).any(axis=1))
    if not len(whole):
        return None, 0.0
    energy = (own[whole] ** 2).sum(axis=1)
    flat = _FLAT * float(np.quantile(energy, 0.9) or energy.max() or 1.0)
    chosen = whole[np.unique(np.linspace(0, len(whole) - 1, _COMPARED).round().astype(np.int64))]
    before = np.flatnonzero(actions >= 0)
    while True:
        apart = distances(own[chosen], own[chosen], mask, flat)
        tried: list[tuple[Part, Ints, Ints, Mask]] = []
        for values, reach in _finer(np.minimum(apart, apart.T)):
            rows = _exemplars(apart, values)
            part = Part(mask, own[chosen[rows]], values[rows], flat, reach)
            found, known, _ = part.read(shapes)
            if tried:
                coarser = tried[-1][2]
                after = actions[before], coarser[before + 1]
                if follows(found[before], *after) < follows(coarser[before], *after) + _EVIDENCE:
                    break
            tried.append((part, values, found, known))
        part, values, _, known = tried[-1]
        singles = float((np.bincount(values) == 1).sum()) / len(values) if len(values) >= _TELLING else 0.0
        strange = np.setdiff1d(np.intersect1d(np.flatnonzero(~known), whole), chosen)
        if singles > _NOISE or not len(strange) or len(chosen) > _COMPARED:
            return (part if part.values.max() > 0 else None), singles
        chosen = np.union1d(chosen, strange[:_COMPARED])


def _finer(apart: Floats) -> Iterator[tuple[Ints, float]]:
    """Groups of crops as :func:`groups` gives them: below the widest gap, then each time below the next one."""
    below = np.inf
    while (found := groups(apart, below))[1] < below:
        yield found
        below = found[1]


def follows(values: Ints, actions: Ints, following: Ints) -> float:
    """Logarithm of how likely values and actions (N,) make the values after them, all tables being alike before."""
    contexts = np.unique(np.stack([values, actions]), axis=1, return_inverse=True)[1].ravel()
    table = np.zeros((contexts.max(initial=-1) + 1, following.max(initial=0) + 1))
    np.add.at(table, (contexts, following), 1.0)
    log = scipy.special.gammaln
    width = table.shape[1]
    return float(log(table + 1.0).sum() + (log(width) - log(width + table.sum(axis=1))).sum())


def lost_by_merging(finer: Codes, coarser: Codes, actions: Ints, following: Codes) -> float:
    """How much likelier ``finer`` codes (N, P) than ``coarser`` ones (N, P) make the next coarser ones (N, P).

    That is :func:`follows`, summed over the factors in which values are merged. 0 unless each factor of the coarser
    codes is one of the finer codes, but for the numbers of its values, or merges values of one. It is rounded, so that
    values that tell as much as merged ones lose nothing.
    """
    lost = 0.0
    for values, after in zip(coarser.T, following.T, strict=True):
        of = [each for each in finer.T if _tells(each, values)]
        if finer.shape != coarser.shape or not of:
            return 0.0
        one = min(of, key=lambda each: len(np.unique(each)))
        if not _tells(values, one):
            lost += follows(one, actions, after) - follows(values, actions, after)
    return round(lost, _DIGITS)


def _tells(one: Ints, other: Ints) -> bool:
    """Whether of two factors (N,) the values of ``one`` leave a single value of ``other`` each."""
    return len(np.unique(np.stack([one, other]), axis=1).T) == len(np.unique(one))


def groups(apart: Floats, below: float = np.inf) -> tuple[Ints, float]:
    """Groups (N,) of crops by their distances (N, N), numbered as they come, and the distance that parts them.

    Only gaps ``below`` a distance count; where there is none, all are one group.
    """
    if len(apart) < 2:
        return np.zeros(len(apart), dtype=np.int64), _OTHER
    tree = scipy.cluster.hierarchy.linkage(apart[np.triu_indices(len(apart), 1)], "average")
    heights = np.concatenate([[_SAME], np.maximum(tree[:, 2], _SAME)])
    ratio = (heights[1:] + _ROUND) / (heights[:-1] + _ROUND)
    ratio[(heights[1:] < _OTHER) | (heights[1:] >= below)] = 0.0
    gap = int(ratio.argmax())
    cut = float(np.sqrt(heights[gap] * heights[gap + 1])) if ratio[gap] > 0.0 else max(_OTHER, float(heights[-1]))
    label = scipy.cluster.hierarchy.fcluster(tree, cut, "distance")
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse.ravel()], cut


def _exemplars(apart: Floats, values: Ints) -> Ints:
    """Rows of crops that stand for each value: each further one is the least like those before."""
    rows: list[int] = []
    for value in range(int(values.max()) + 1):
        own = np.flatnonzero(values == value)
        nearest = apart[own[0], own]
        rows.append(int(own[0]))
        for _ in range(min(_EXEMPLARS, len(own)) - 1):
            if nearest.max() < _SAME / 2.0:
                break
            rows.append(int(own[nearest.argmax()]))
            nearest = np.minimum(nearest, apart[rows[-1], own])
    return np.array(rows)
