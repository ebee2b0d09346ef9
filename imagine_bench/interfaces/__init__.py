"""The interfaces that tasks, agents, world models and the bench share: numpy and the standard library only.

A *task* offers frames, macro-actions and exact rules. An *agent* offers actions. The *bench* knows both by these
interfaces alone. Shapes: ``H = W = 64`` pixels, ``A`` macro-actions, ``M`` coordinates of a macrostate.
"""

from imagine_bench.appearance import APPEARANCES, HELD_OUT, appearance_of_tests
from imagine_bench.arrays import Arrays, Floats, Frame, Macrostate, State
from imagine_bench.interfaces.agent import DEVICES, Agent, AgentContext, AgentState, ExactWorld, FrameEncoder
from imagine_bench.interfaces.observation import (
    FRAME_PX,
    OBSERVATION_SIZES_PX,
    OBSERVATIONS,
    PROPRIO_SIZE,
    Observation,
    Transition,
)
from imagine_bench.interfaces.scene import ArmMotion, ArmReader, Motion, SceneReader, Shape3D
from imagine_bench.interfaces.task import (
    EXECUTIONS,
    PHYSICS_RANGES,
    SENSES,
    ObservationModel,
    PerformanceTargets,
    PhysicsSettings,
    RenderMacrostates,
    TaskSpec,
    bundled_name,
)
from imagine_bench.rules import Outcome, RuleFacts, Rules

__all__ = [
    "APPEARANCES",
    "Agent",
    "AgentContext",
    "AgentState",
    "ArmMotion",
    "ArmReader",
    "Arrays",
    "DEVICES",
    "EXECUTIONS",
    "ExactWorld",
    "FRAME_PX",
    "Floats",
    "Frame",
    "FrameEncoder",
    "HELD_OUT",
    "Macrostate",
    "Motion",
    "OBSERVATIONS",
    "OBSERVATION_SIZES_PX",
    "Observation",
    "Outcome",
    "PHYSICS_RANGES",
    "PROPRIO_SIZE",
    "PerformanceTargets",
    "PhysicsSettings",
    "RenderMacrostates",
    "RuleFacts",
    "Rules",
    "SENSES",
    "SceneReader",
    "Shape3D",
    "ObservationModel",
    "State",
    "TaskSpec",
    "Transition",
    "appearance_of_tests",
    "bundled_name",
]
