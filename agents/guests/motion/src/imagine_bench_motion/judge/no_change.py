"""One end of the scale: a model that says that no motion changes anything."""

from __future__ import annotations

from imagine_bench.arrays import Floats32, Frame, Ints
from imagine_bench.interfaces import AgentContext
from imagine_bench.interfaces.model import Untaught


class NoChange(Untaught):
    """Hands back the frame before; see :class:`.interface.MotionModel`."""

    def imagine_motion(self, frames: Frame, actions: Floats32, lengths: Ints, labels: Ints) -> Frame:
        """The frame before each motion."""
        del actions, lengths, labels
        return frames


def make(context: AgentContext) -> NoChange:
    """The model for any task."""
    del context
    return NoChange()
