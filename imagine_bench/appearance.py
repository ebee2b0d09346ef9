"""How frames look, by name: a level, or factors, such as ``light=0.5,camera=0.2`` or ``noise=1.5``.

Four levels are points of these factors; ``patched`` is none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from imagine_bench.errors import InvalidValueError, UnknownNameError, brief, require_known

APPEARANCES = ("clean", "mild", "strong", "patched", "harsh")
"""The levels, as people type and read them."""
STORED_AS: Mapping[str, str] = {"patched": "photo", "patched_held_out": "photo_held_out"}
"""By each level that was renamed, the older spelling. It is read everywhere, and files, hashes and seeds hold it."""
HELD_OUT: Mapping[str, str] = {"photo": "photo_held_out"}
"""By each appearance that is drawn from finitely many images, the appearance of the images kept for tests."""
FACTORS = ("light", "colors", "camera", "pose", "hand")
"""Brightness; colors; the camera's pose; how objects lie at the start; the hand's pose. Each is from 0 to 1."""
NUISANCES = ("shift", "shadow", "noise", "occlusion", "reward_noise", "reward_steps")
"""A shift of an episode's frames; a soft shadow that moves; the sensor's noise; something in the way; Gaussian noise of
rewards; one of three rewards by chance. Each is from 0 to 2, and 1 is the value of ``harsh``."""
MOST: Mapping[str, float] = {**dict.fromkeys(FACTORS, 1.0), **dict.fromkeys(NUISANCES, 2.0)}
"""The largest value of each factor, in the order in which names hold them."""
POINTS: Mapping[str, Mapping[str, float]] = {
    "clean": {},
    "mild": {"light": 0.5, "pose": 0.5, "hand": 0.5},
    "strong": dict.fromkeys(FACTORS, 1.0),
    "harsh": dict.fromkeys(NUISANCES[:6], 1.0),  # a nuisance that is added later would change its frames
}
"""Levels by their factors; a factor that is not named is 0."""
_EXAMPLE = "light=0.5,camera=0.2"


def appearance_name(given: str | Mapping[str, float], known: Iterable[str] = APPEARANCES) -> str:
    """The one name that files hold: a level's where it is one, else its factors above 0 in the order of MOST.

    Raises:
        UnknownNameError: No level or factor of that name.
        InvalidValueError: A factor that is twice there, or no number from 0 to the factor's largest value.
    """
    if not isinstance(given, Mapping) and not (isinstance(given, str) and "=" in given):
        typed = appearance_typed(given) if isinstance(given, str) else given
        require_known("appearance", typed, (*map(appearance_typed, known), f"factors such as {_EXAMPLE}"))
        return STORED_AS.get(typed, typed)
    shares = factors_of(given)
    said = ",".join(f"{name}={share}" for name, share in shares.items())
    return next((level for level, point in POINTS.items() if point == shares), said)


def appearance_typed(stored: str) -> str:
    """The name of an appearance as people type and read it, from the one that files hold."""
    return next((typed for typed, older in STORED_AS.items() if older == stored), stored)


def factors_of(given: str | Mapping[str, float]) -> dict[str, float]:
    """The factors above 0, in the order of MOST, of a mapping or a text. Raises as :func:`appearance_name`."""
    shares = dict[str, float]()
    pairs = given.items() if isinstance(given, Mapping) else [pair.partition("=")[::2] for pair in given.split(",")]
    for name, share in pairs:
        if name not in MOST:
            raise UnknownNameError("factor of appearance", name, MOST)
        if name in shares:
            raise InvalidValueError(f"Appearance {brief(given)} names {name} twice; give it once.")
        try:
            shares[name] = -1.0 if isinstance(share, bool) else float(share)
        except (TypeError, ValueError, OverflowError):
            shares[name] = -1.0
        if not 0.0 <= shares[name] <= MOST[name]:
            raise InvalidValueError(f"Appearance has {name}={brief(share)}; give a number from 0 to {MOST[name]:g}.")
    return {name: shares[name] for name in MOST if shares.get(name)}


def appearance_of_tests(appearance: str) -> str:
    """The appearance that tests have where training has ``appearance``."""
    return HELD_OUT.get(appearance, appearance)
