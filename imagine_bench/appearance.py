"""How frames look, by name: a level, or factors from 0 to 1, such as ``light=0.5,camera=0.2``.

Three levels are points of these factors; ``patched`` is none.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from imagine_bench.errors import InvalidValueError, UnknownNameError, brief, require_known

APPEARANCES = ("clean", "mild", "strong", "patched")
"""The levels, as people type and read them."""
STORED_AS: Mapping[str, str] = {"patched": "photo", "patched_held_out": "photo_held_out"}
"""By each level that was renamed, the older spelling. It is read everywhere, and files, hashes and seeds hold it."""
HELD_OUT: Mapping[str, str] = {"photo": "photo_held_out"}
"""By each appearance that is drawn from finitely many images, the appearance of the images kept for tests."""
FACTORS = ("light", "colors", "camera", "pose", "hand")
"""Brightness; colors; the camera's pose; how objects lie at the start; the hand's pose."""
POINTS: Mapping[str, Mapping[str, float]] = {
    "clean": {},
    "mild": {"light": 0.5, "pose": 0.5, "hand": 0.5},
    "strong": dict.fromkeys(FACTORS, 1.0),
}
"""Levels by their factors, ascending; a factor that is not named is 0."""
_EXAMPLE = "light=0.5,camera=0.2"


def appearance_name(given: str | Mapping[str, float], known: Iterable[str] = APPEARANCES) -> str:
    """The one name that files hold: a level's where it is one, else its factors above 0 in the order of FACTORS.

    Raises:
        UnknownNameError: No level or factor of that name.
        InvalidValueError: A factor that is twice there, or no number from 0 to 1.
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
    """The factors above 0, in the order of FACTORS, of a mapping or a text. Raises as :func:`appearance_name`."""
    shares = dict[str, float]()
    pairs = given.items() if isinstance(given, Mapping) else [pair.partition("=")[::2] for pair in given.split(",")]
    for name, share in pairs:
        if name not in FACTORS:
            raise UnknownNameError("factor of appearance", name, FACTORS)
        if name in shares:
            raise InvalidValueError(f"Appearance {brief(given)} names {name} twice; give it once.")
        try:
            shares[name] = -1.0 if isinstance(share, bool) else float(share)
        except (TypeError, ValueError, OverflowError):
            shares[name] = -1.0
        if not 0.0 <= shares[name] <= 1.0:
            raise InvalidValueError(f"Appearance has {name}={brief(share)}; give a number from 0 to 1.")
    return {name: shares[name] for name in FACTORS if shares.get(name)}


def appearance_of_tests(appearance: str) -> str:
    """The appearance that tests have where training has ``appearance``."""
    return HELD_OUT.get(appearance, appearance)
