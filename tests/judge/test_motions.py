"""Models of motions are judged by the simulator, also where a motion grips nothing."""

from __future__ import annotations

import numpy as np
import pytest
from imagine_bench.agents.world_models.limits import Copy
from imagine_bench.agents.world_models.recurrent import MotionNetwork
from imagine_bench.tasks.continuous.spec import make_arrows

from imagine_bench.arrays import Array, Ints
from imagine_bench.errors import InvalidValueError
from imagine_bench.interfaces.motion import Motions
from imagine_bench.judge.motion.questions import MotionSource
from imagine_bench.judge.motion.scores import MotionQuestions, Simulator, score


class KnownFrames:
    """Reads the frames of some motions, and nothing else."""

    def __init__(self, asked: MotionQuestions) -> None:
        self._shows = {}
        for motions in (asked.planned, asked.raised, *asked.chains):
            for frames, states in ((motions.before, motions.states), (motions.after, motions.reached)):
                self._shows |= {frame.tobytes(): state for frame, state in zip(frames, states, strict=True)}

    def read(self, pictures: Array) -> Ints:
        """The macrostates (N, M) of frames."""
        return np.array([self._shows[picture.tobytes()] for picture in pictures])


@pytest.fixture(scope="module")
def asked() -> MotionQuestions:
    """A few questions of the arrow puzzle."""
    source = MotionSource(make_arrows(observation="proprio", time_limit_s=1e9))
    rng = np.random.default_rng(0)
    planned, raised = source.pairs(5, rng)
    return MotionQuestions(planned=planned, raised=raised, chains=source.chains(2, 2, rng))


def test_a_pair_begins_alike_and_only_the_lower_motion_turns_a_cube(asked: MotionQuestions) -> None:
    planned, raised = asked.planned, asked.raised
    np.testing.assert_array_equal(planned.before, raised.before)
    np.testing.assert_array_equal(planned.labels, raised.labels)
    np.testing.assert_array_equal(raised.states, raised.reached)
    turned = (planned.reached - planned.states) % 4
    cubes = np.arange(3) == planned.labels[:, None] // 2
    np.testing.assert_array_equal(turned[:, :3], np.where(cubes, np.where(planned.labels % 2, 3, 1)[:, None], 0))
    assert planned.proper.all()
    assert raised.proper.all()


def test_each_motion_of_a_chain_begins_where_the_one_before_ended(asked: MotionQuestions) -> None:
    first, second = asked.chains
    np.testing.assert_array_equal(first.reached, second.states)
    np.testing.assert_array_equal(first.after, second.before)


def test_the_simulator_is_right_in_all_and_a_copy_where_nothing_changes(asked: MotionQuestions) -> None:
    reader = KnownFrames(asked)
    exact = score("simulator", Simulator(asked), asked, reader, 0.0)
    assert (exact.right, exact.nothing_right, exact.painted, exact.pairs, exact.by_depth) == (1, 1, 0, 1, (1, 1))
    copied = score("copy", Copy(None), asked, reader, 0.0)
    assert (copied.right, copied.nothing_right, copied.painted, copied.pairs, copied.by_depth) == (0, 1, 0, 0, (0, 0))


def test_what_is_no_frame_is_refused(asked: MotionQuestions) -> None:
    class Half(Copy):
        def imagine_motion(self, frames: Array, actions: Array, lengths: Ints, labels: Ints) -> Array:
            return frames[::2]

    with pytest.raises(InvalidValueError, match=r"half: imagine_motion\(\) gave uint8 \(3, 64, 64, 3\)"):
        score("half", Half(None), asked, KnownFrames(asked), 0.0)


def test_commands_after_a_motions_end_change_nothing_that_a_network_imagines(asked: MotionQuestions) -> None:
    import torch

    torch.manual_seed(0)
    motions: Motions = asked.planned
    network = MotionNetwork(motions.actions.shape[2])
    frames = torch.rand(len(motions), 3, 64, 64)
    actions = torch.from_numpy(motions.actions)
    lengths = torch.from_numpy(motions.lengths)
    longer = torch.cat([actions, torch.zeros(len(actions), 7, actions.shape[2])], dim=1)
    with torch.no_grad():
        torch.testing.assert_close(network(frames, actions, lengths), network(frames, longer, lengths))
