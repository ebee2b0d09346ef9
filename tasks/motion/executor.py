"""Runs planned motions in the contact simulation, always from a canonical start: equal starts give equal bits."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import mujoco
import mujoco.rollout
import numpy as np

from imagine_bench.arrays import Floats
from imagine_bench.errors import DivergedError

from ..scenes.arm import ARM_JOINTS, arm_columns
from ..scenes.constants import OBSERVATION_QPOS_RAD
from .arm_model import ArmModel
from .orientation import Sensing
from .trajectory import Trajectory, Waypoint, plan

REST_OPENING_M = 0.0365
"""Each finger's distance from the grip's middle between macro-actions: a cube's half and 9 mm."""

BLEND_S = 0.10
"""Going down begins so long before the reach ends, and the return so long before the gripper is fully up."""
_ARM_AT_REST_RAD = 0.02
"""An arm that ends further off its observation pose, in any joint, is a fault."""
_RUNAWAY_RAD_S = 200.0
"""Nothing in the scene moves so fast (rad/s or m/s) unless the simulation has exploded."""
MAX_SAVED = 10
"""So many starts of simulations that blew up are kept in the temporary folder, of all processes together."""
_SAVED = "imagine_bench_diverged_"
_STATE = mujoco.mjtState
_MOCAP = _STATE.mjSTATE_MOCAP_POS.value | _STATE.mjSTATE_MOCAP_QUAT.value
_KEPT = _STATE.mjSTATE_QPOS.value | _MOCAP
_INPUTS = _STATE.mjSTATE_CTRL.value | _MOCAP
"""The input of a rollout at every step, controls first; mocap bodies left out would fall back to their defaults."""
_BAD_STATE = slice(mujoco.mjtWarning.mjWARN_BADQPOS.value, mujoco.mjtWarning.mjWARN_BADQACC.value + 1)
"""Of MuJoCo's warnings: NaN or a huge number in positions, velocities or accelerations."""


def back_to_rest(opening_m: float, settle_s: float) -> list[Waypoint]:
    """Back to the observation pose, and a moment of calm there."""
    observe = np.array(OBSERVATION_QPOS_RAD)
    return [
        Waypoint("return", observe, opening_m),
        Waypoint("settle", observe, opening_m, min_duration_s=settle_s),
    ]


def at_rest(model: mujoco.MjModel) -> tuple[Floats, Floats]:
    """Positions (nq,) and controls (nu,) of a whole scene, its arm at the observation pose with open fingers."""
    qpos = model.qpos0.copy()
    ctrl = np.zeros(model.nu)
    columns = arm_columns(model)
    targets = (*OBSERVATION_QPOS_RAD, REST_OPENING_M, REST_OPENING_M)
    qpos[columns.qpos] = targets
    ctrl[columns.ctrl] = targets
    return qpos, ctrl


def blew_up(data: mujoco.MjData) -> bool:
    """Whether a simulation has seen NaN, infinity or runaway speed since its data were reset."""
    speeds = data.qvel
    slow = speeds.dot(speeds) < _RUNAWAY_RAD_S**2 or np.abs(speeds).max() < _RUNAWAY_RAD_S
    return not slow or any(data.warning.number.tolist()[_BAD_STATE])


class Samples(NamedTuple):
    """A motion of a whole scene, for a recording."""

    time_s: Floats  #: when the samples were taken, from 0. Shape (K,), K = 0 without capture.
    qpos: Floats  #: positions. Shape (K, nq).
    qvel: Floats  #: velocities. Shape (K, nv).
    ctrl: Floats  #: commands to the servos from then on, at the end the last ones. Shape (K, nu).


@dataclass(frozen=True, kw_only=True)
class MacroResult:
    """The result of one macro-action."""

    sim_time_s: float = 0.0  #: simulated seconds
    ik_error_m: float = 0.0  #: largest distance between a solved waypoint and its target
    fault: str | None  #: why the action failed physically, in words, or None
    motion: Samples

    def then(self, later: MacroResult) -> MacroResult:
        """Both as one macro-action; the first fault is its fault."""
        shifted = later.motion._replace(time_s=later.motion.time_s + self.sim_time_s)
        return MacroResult(
            sim_time_s=self.sim_time_s + later.sim_time_s,
            ik_error_m=max(self.ik_error_m, later.ik_error_m),
            fault=self.fault or later.fault,
            motion=Samples(*map(np.concatenate, zip(self.motion, shifted, strict=True))),
        )


class MacroExecutor:
    """Executes trajectories on a compiled scene that holds the arm: the base of planners of macro-actions.

    Before and after each macro-action the arm is set onto its observation pose; one that ended further off it than
    0.02 rad is a fault. Its planner measures true poses of objects, unless
    :class:`.orientation.Sensing` says else.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, sensing: Sensing) -> None:
        self.model = model
        self.data = data
        self.arm = ArmModel()
        self.sensing = sensing
        self.trajectory: Trajectory | None = None  # the latest that was run
        self.capture_motion_hz = 0.0  # samples of a motion a second for a recording; 0 takes none
        columns = arm_columns(model)
        self._arm_qpos, self._finger_qpos = np.split(columns.qpos, [len(ARM_JOINTS)])
        self._arm_ctrl, self._finger_ctrl = np.split(columns.ctrl, [len(ARM_JOINTS)])
        self._qpos_column = mujoco.mj_stateSize(model, _STATE.mjSTATE_TIME.value)
        # Kept between runs: fresh pages cost time.
        self._states = np.empty((0, mujoco.mj_stateSize(model, _STATE.mjSTATE_FULLPHYSICS.value)))
        self._control = np.empty((0, mujoco.mj_stateSize(model, _INPUTS)))

    def rest(self, *, squeeze_m: float | None = None) -> None:
        """Bring ``data`` to the canonical start, in place: the arm at its observation pose, everything still.

        Only the positions of loose objects and of mocap bodies survive, and those of fingers that hold something;
        velocities, warm start, sleep states, time and controls are as if new. Hence the motion depends on those
        positions and on ``squeeze_m`` alone: the command to each finger that keeps an object held, or None, which opens
        the fingers to where they rest. Derived quantities are not updated.
        """
        kept = np.empty(mujoco.mj_stateSize(self.model, _KEPT))
        mujoco.mj_getState(self.model, self.data, kept, _KEPT)
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, kept, _KEPT)
        self.data.qpos[self._arm_qpos] = OBSERVATION_QPOS_RAD
        if squeeze_m is None:
            self.data.qpos[self._finger_qpos] = REST_OPENING_M
        self.data.ctrl[self._arm_ctrl] = OBSERVATION_QPOS_RAD
        self.data.ctrl[self._finger_ctrl] = REST_OPENING_M if squeeze_m is None else squeeze_m

    def perform(
        self,
        waypoints: Sequence[Waypoint],
        *,
        ik_error_m: float,
        squeeze_m: float | None = None,
    ) -> tuple[MacroResult, Floats, Trajectory]:
        """Plan a motion through ``waypoints``, the last of which is the observation pose, and execute it.

        ``squeeze_m`` is as in :meth:`rest`.

        Returns:
            The result, whose fault says whether the arm came back; the positions as :meth:`run`; and the plan.
        """
        timestep_s = self.model.opt.timestep
        trajectory = plan(
            self.arm,
            start_qpos_rad=np.array(OBSERVATION_QPOS_RAD),
            start_opening_m=REST_OPENING_M if squeeze_m is None else squeeze_m,
            waypoints=waypoints,
            timestep_s=timestep_s,
        )
        qpos = self.run(trajectory, squeeze_m=squeeze_m)
        steps = len(qpos) - 1
        off_rad = float(np.abs(qpos[-1, self._arm_qpos] - OBSERVATION_QPOS_RAD).max())
        result = MacroResult(
            sim_time_s=steps * timestep_s,
            ik_error_m=ik_error_m,
            fault=f"the arm ended {off_rad:.3f} rad off its observation pose" if off_rad > _ARM_AT_REST_RAD else None,
            motion=self._capture(steps),
        )
        return result, qpos, trajectory

    def refused(self, reason: str) -> MacroResult:
        """The result of a macro-action for which the arm, which holds nothing, does not move."""
        self.rest()
        return MacroResult(fault=reason, motion=self.no_samples())

    def run(self, trajectory: Trajectory, *, squeeze_m: float | None = None) -> Floats:
        """Execute ``trajectory``, planned at the model's timestep, from the canonical start.

        The derived quantities of ``data`` (such as ``xpos``) are then those of the last step.

        Returns:
            Positions of the whole scene, row 0 at the start, row k after step k; valid until the next run.
            Shape (N + 1, nq).

        Raises:
            DivergedError: NaN, infinity or runaway speed; the message names the saved start.
        """
        self.trajectory = trajectory
        self.rest(squeeze_m=squeeze_m)
        steps = len(trajectory.opening_m)
        if len(self._control) < steps:
            self._states = np.empty((steps + 1, self._states.shape[1]))
            self._control = np.empty((steps, self._control.shape[1]))
        states = self._states[: steps + 1]
        control = self._control[:steps]
        mujoco.mj_getState(self.model, self.data, states[0], _STATE.mjSTATE_FULLPHYSICS.value)
        mujoco.mj_getState(self.model, self.data, control[0], _INPUTS)
        control[1:] = control[0]
        control[:, self._arm_ctrl] = trajectory.arm_command_rad
        control[:, self._finger_ctrl] = trajectory.opening_m[:, None]
        mujoco.rollout.rollout(self.model, self.data, states[0], control, control_spec=_INPUTS, state=states[None, 1:])
        if blew_up(self.data) or not np.isfinite(states[-1]).all():
            raise self._divergence(states[0], control)
        return states[:, self._qpos_column : self._qpos_column + self.model.nq]

    def _divergence(self, start: Floats, control: Floats) -> DivergedError:
        """Save a start and its controls (N, C) to be looked into; the newest few are kept."""
        try:
            handle, path = tempfile.mkstemp(prefix=_SAVED, suffix=".npz")
            with os.fdopen(handle, "wb") as file:
                np.savez(file, start_state=start, control=control[:, : self.model.nu])
            where = f"were saved in {path}"
        except OSError as error:
            where = f"could not be saved ({error})"
        with contextlib.suppress(OSError):  # another process may delete them, and may own them
            saved = sorted(Path(tempfile.gettempdir()).glob(f"{_SAVED}*.npz"), key=os.path.getmtime)
            for oldest in saved[:-MAX_SAVED]:
                oldest.unlink()
        return DivergedError(
            "The simulation of a macro-action diverged (NaN, infinity or runaway speed); "
            f"its start state and controls {where}."
        )

    def opening_m(self, qpos: Floats) -> Floats:
        """Each finger's distance from the grip's middle in positions of the scene: (..., nq) to (..., 2)."""
        return qpos[..., self._finger_qpos]

    def no_samples(self) -> Samples:
        """The samples of a motion that is not captured, or of none."""
        model = self.model
        return Samples(np.empty(0), np.empty((0, model.nq)), np.empty((0, model.nv)), np.empty((0, model.nu)))

    def _capture(self, steps: int) -> Samples:
        """Samples of the latest run, of so many steps: ``capture_motion_hz`` a second.

        Up to one a timestep they are steps of the simulation. Above, the motion between two steps is interpolated
        linearly, as the integrator moves positions; commands are held.

        Returns:
            The samples, with the first and the last step whenever any are taken.
        """
        if self.capture_motion_hz <= 0:
            return self.no_samples()
        timestep_s = self.model.opt.timestep
        nq = self.model.nq
        stride = 1.0 / (self.capture_motion_hz * timestep_s)
        at = np.append(np.arange(0, steps - 1e-9, stride), steps)  # in timesteps [K]
        at = np.unique(np.round(at)) if stride >= 1.0 else at
        before = np.minimum(at.astype(np.int64), steps - 1)
        share = (at - before)[:, None]
        moving = self._states[:, self._qpos_column : self._qpos_column + nq + self.model.nv]
        samples = (1.0 - share) * moving[before] + share * moving[before + 1]
        for row in np.flatnonzero(share % 1.0):
            mujoco.mj_normalizeQuat(self.model, samples[row, :nq])
        return Samples(at * timestep_s, samples[:, :nq], samples[:, nq:], self._control[before, : self.model.nu])
