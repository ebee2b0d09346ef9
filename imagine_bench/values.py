"""The values that settings and JSON files hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Scalar = bool | int | float | str | None
Setting = Scalar | tuple[Scalar, ...] | list[Scalar] | dict[str, Scalar]
"""The value of an agent's setting, as JSON has it."""
Json = Scalar | Sequence["Json"] | Mapping[str, "Json"]
"""A value that a JSON file can hold."""


def dotted(settings: Mapping[str, Setting], before: str = "") -> dict[str, Setting]:
    """Settings, nested or not, by dotted name, such as ``controller.discount``."""
    found: dict[str, Setting] = {}
    for name, value in settings.items():
        found |= dotted(value, f"{before}{name}.") if isinstance(value, Mapping) else {f"{before}{name}": value}
    return found
