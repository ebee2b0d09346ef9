"""The protocol of a regression bench: which regressors learn which variants, how many networks, from which seeds."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from imagine_bench import registry
from imagine_bench.errors import InvalidValueError, require_known
from imagine_bench.interfaces import DEVICES
from imagine_bench.protocols.data import ProtocolData, digest, require_different, require_seeds
from imagine_bench.registry.entries import entrant

_SETTINGS = "imagine_bench.agents.regressors.settings:resolve_all"
_CHECK_DEVICE = "imagine_bench.agents.encoders.perception:prepare_torch"


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
        if not self.variants:
            object.__setattr__(self, "variants", spec.variants)
        for variant in self.variants:
            spec.require_variant(variant)
        object.__setattr__(self, "agents", tuple(str(entrant(agent)) for agent in self.agents))
        for agent in self.agents:
            registry.regressor_entry(agent)
        require_different("agents", self.agents)
        require_different("variants", self.variants)
        require_known("device", self.device, DEVICES)
        require_seeds(self.seeds)
        for name, low, high in (("networks", 1, 1000), ("test_points", 2, 10**5)):
            if not low <= (value := getattr(self, name)) <= high:
                raise InvalidValueError(f"{name} is {value}; it must lie in [{low}, {high}].")

    def work(self, agent: str, until: int | None = None) -> int:
        """Units of a run's work: 100 a variant for training, 10 for measuring; it never pauses before its end."""
        return 110 * len(self.variants)


def overrides_of(protocol: RegressionProtocol, agent: str) -> dict[str, Any]:
    """The settings that replace those of the set for one regressor: the protocol's, above them the entrant's own."""
    return {**dict(protocol.overrides), **entrant(agent).settings}


PRESETS: dict[str, dict[str, Any]] = {
    "smoke": {"hyperparameters": "minimal", "networks": 2, "test_points": 50},
    "quick": {},
    "thesis": {"hyperparameters": "published", "networks": 10, "test_points": 500},
    "full": {"hyperparameters": "published", "networks": 20, "test_points": 1000},
}
"""What each preset changes: ``thesis`` is chapter 4 as printed, ten networks on ten datasets."""


def plan(
    task: str, preset: str, *, encoder: str | None = None, **changes: Any
) -> tuple[RegressionProtocol, dict[str, Path]]:
    """The protocol of a bench, with everything checked that can be before anything is run; it has no encoder.

    Raises:
        UnknownNameError: Any name that does not exist; the message lists those that do.
        InvalidValueError: A value out of its range.
        SetupError: The device does not exist here.
    """
    if encoder is not None:
        raise InvalidValueError(f"{task} has no images to encode; leave --encoder out.")
    require_known("preset", preset, PRESETS)
    values = {**PRESETS[preset], **changes}
    if preset == "smoke":
        values.setdefault("variants", registry.regression(task).variants[:2])
    if "seeds" in values:  # in whatever order they are given, it is the same bench
        values["seeds"] = tuple(sorted(values["seeds"]))
    wanted = RegressionProtocol(task=task, preset=preset, **values)
    check = registry.load(_SETTINGS)
    settings = check(wanted.hyperparameters, dict(wanted.overrides))
    for agent in wanted.agents:
        check(wanted.hyperparameters, overrides_of(wanted, agent))
    if wanted.device != "cpu":
        registry.load(_CHECK_DEVICE)(wanted.device)
    return replace(wanted, settings_digest=digest([asdict(one) for one in settings])), {}
