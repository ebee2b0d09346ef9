"""The interfaces that tasks, agents, world models and the bench share: numpy and the standard library only.

A *task* offers frames, macro-actions and exact rules. An *agent* offers actions. The *bench* knows both by these
interfaces alone. Shapes: ``H = W = 64`` pixels, ``A`` macro-actions, ``M`` coordinates of a macrostate.
"""

from imagine_bench.appearance import APPEARANCES as APPEARANCES
from imagine_bench.appearance import HELD_OUT as HELD_OUT
from imagine_bench.appearance import appearance_of_tests as appearance_of_tests
from imagine_bench.arrays import Arrays as Arrays
from imagine_bench.arrays import Floats as Floats
from imagine_bench.arrays import Frame as Frame
from imagine_bench.arrays import Macrostate as Macrostate
from imagine_bench.arrays import State as State
from imagine_bench.interfaces.agent import DEVICES as DEVICES
from imagine_bench.interfaces.agent import Agent as Agent
from imagine_bench.interfaces.agent import AgentContext as AgentContext
from imagine_bench.interfaces.agent import AgentState as AgentState
from imagine_bench.interfaces.agent import ExactWorld as ExactWorld
from imagine_bench.interfaces.agent import FrameEncoder as FrameEncoder
from imagine_bench.interfaces.observation import FRAME_PX as FRAME_PX
from imagine_bench.interfaces.observation import OBSERVATION_SIZES_PX as OBSERVATION_SIZES_PX
from imagine_bench.interfaces.observation import OBSERVATIONS as OBSERVATIONS
from imagine_bench.interfaces.observation import PROPRIO_SIZE as PROPRIO_SIZE
from imagine_bench.interfaces.observation import Observation as Observation
from imagine_bench.interfaces.observation import Transition as Transition
from imagine_bench.interfaces.scene import ArmMotion as ArmMotion
from imagine_bench.interfaces.scene import ArmReader as ArmReader
from imagine_bench.interfaces.scene import Motion as Motion
from imagine_bench.interfaces.scene import SceneReader as SceneReader
from imagine_bench.interfaces.scene import Shape3D as Shape3D
from imagine_bench.interfaces.task import EXECUTIONS as EXECUTIONS
from imagine_bench.interfaces.task import PHYSICS_RANGES as PHYSICS_RANGES
from imagine_bench.interfaces.task import SENSES as SENSES
from imagine_bench.interfaces.task import PerformanceTargets as PerformanceTargets
from imagine_bench.interfaces.task import PhysicsSettings as PhysicsSettings
from imagine_bench.interfaces.task import RenderMacrostates as RenderMacrostates
from imagine_bench.interfaces.task import Sight as Sight
from imagine_bench.interfaces.task import TaskSpec as TaskSpec
from imagine_bench.interfaces.task import bundled_name as bundled_name
from imagine_bench.rules import Outcome as Outcome
from imagine_bench.rules import RuleFacts as RuleFacts
from imagine_bench.rules import Rules as Rules
