"""Settings of agents and models that are programs."""

from __future__ import annotations

from dataclasses import dataclass

from imagine_bench.agents.settings import Hyperparameters, setting

SYMBOLS = ("macrostates", "codes")


@dataclass(frozen=True, kw_only=True)
class ProgramSettings:
    """All settings of ``program:FILE.py``."""

    #: The symbols that the program is given: the coordinates of the macrostate, as the encoder's probe reads them, or
    #: the encoder's own codes. The probe was trained with true macrostates, which no learner is shown.
    symbols: str = setting("macrostates", SYMBOLS)


HYPERPARAMETERS = Hyperparameters.everywhere(ProgramSettings())
