"""The protocol of a regression bench: which regressors learn which variants, how many networks, from which seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.protocols.data import ProtocolData, digest, package_digests, require_different
from imagine_bench.registry.entries import parse_configuration
from imagine_bench.values import Json, Setting


@dataclass(frozen=True, kw_only=True)
class RegressionProtocol(ProtocolData):
    """One comparison of regressors, completely specified.

    A run is one regressor and one seed: it trains ``networks`` networks on every variant, each on data of its own, as
    one batched computation, and that is why they share a run.
    """

    hyperparameters: str = "fast"  #: set of the regressors' settings: ``"minimal"``, ``"fast"`` or ``"published"``
    #: Variants of the task, in the order of the report; the task's own where none are given.
    variants: tuple[str, ...] = ()
    agents: tuple[str, ...] = ("mc_dropout", "ensemble")
    seeds: tuple[int, ...] = (0,)
    networks: int = 3  #: networks a run and variant, each on data drawn for it; in [1, 1000]
    test_points: int = 500  #: unseen points of each network, for errors and calibration; in [2, 100000]
    recorded: bool = True  #: whether runs leave a recording

    def __post_init__(self) -> None:
        super().__post_init__()
        spec = registry.regression(self.task)
        object.__setattr__(self, "variants", self.variants or spec.variants)
        require_different("variants", self.variants)
        for variant in self.variants:
            spec.require_variant(variant)
        for agent in self.agents:
            registry.regressor_entry(agent)
        if not (1 <= self.networks <= 1000 and 2 <= self.test_points <= 10**5):
            raise InvalidValueError(
                f"networks is {self.networks} and test_points {self.test_points}; they must lie in [1, 1000] and "
                "[2, 100000]."
            )

    def code_places(self) -> dict[str, str]:
        """As :meth:`.ProtocolData.code_places`."""
        return {parse_configuration(agent).agent: registry.regressor_entry(agent).make for agent in self.agents}

    def work(self, agent: str) -> int:
        """Units of a run's work: 110 a variant, the last ten for measuring."""
        return 110 * len(self.variants)

    def overrides_of(self, agent: str) -> dict[str, Setting]:
        """The settings that replace those of the set for one regressor: the protocol's, above them its name's."""
        return {**dict(self.overrides), **parse_configuration(agent).settings}


PRESETS: Mapping[str, Mapping[str, Setting]] = {
    "smoke": {"hyperparameters": "minimal", "networks": 2, "test_points": 50},
    "quick": {},
    "thesis": {"hyperparameters": "published", "networks": 10},
    "full": {"hyperparameters": "published", "networks": 20, "test_points": 1000},
}
"""The changes of each preset: ``thesis`` is chapter 4 as printed, ten networks on ten datasets; ``smoke`` has only the
first two variants."""


def plan(task: str, preset: str, **changes: Any) -> tuple[RegressionProtocol, dict[str, Path]]:
    """The protocol of a bench, with everything checked that can be before anything is run; it has no encoder.

    Raises:
        UnknownNameError: Any name that does not exist; the message lists those that do.
        InvalidValueError: A value out of its range.
    """
    values = {**PRESETS[require_known("preset", preset, PRESETS)], **changes}
    if preset == "smoke":
        values.setdefault("variants", registry.regression(task).variants[:2])
    wanted = RegressionProtocol(task=task, preset=preset, **values)
    settings = _every_setting(wanted)
    return replace(wanted, settings_digest=digest(settings), code=package_digests(wanted.code_places())), {}


def _every_setting(wanted: RegressionProtocol) -> list[Json]:
    """All settings of every regressor in each of its groups, those that its name gives checked. Raises as :func:`plan`.

    Also SetupError: a package offers settings wrongly.
    """
    found: dict[str, list[Json]] = {}
    for agent in wanted.agents:
        given = wanted.overrides_of(agent)
        target = registry.regressor_entry(agent).settings
        if not target and given:
            raise InvalidValueError(f"Regressor {agent} names no settings; leave {', '.join(sorted(given))} out.")
        if target:
            with registry.guests_faults(f"Regressor {agent}, its settings", target):
                known = registry.load(target)
                groups = list(known.groups)
                group = parse_configuration(agent).agent
                known.resolve(wanted.hyperparameters, given, group if group in groups else groups[0])
                overrides = dict(wanted.overrides)
                found[target] = [asdict(known.resolve(wanted.hyperparameters, overrides, each)) for each in groups]
    return [each for settings in found.values() for each in settings]
