"""Numbers that more than one part of a scene, or more than one scene, needs, each with its unit.

World frame: x away from the robot's base, y to the robot's left, z up, origin at the base. The human sits at the far
side (+x) and appears at the top of the agent's frame; the frame's right is -y.
"""

from __future__ import annotations

Point = tuple[float, float, float]
"""x, y and z in metres."""
TIMESTEP_S = 0.008
"""The arrow puzzle's. Coarse, for speed: `make speed` measures that every turn still comes out right, with a yaw error
under 1 degree. A finer step is more exact and costs in proportion; objects that are carried want at most 5 ms."""

TABLE_HEIGHT_M = -0.10
"""Height of the table's surface."""

CUBE_EDGE_M = 0.055
CUBE_MASS_KG = 0.12
CUBE_REST_Z_M = TABLE_HEIGHT_M + CUBE_EDGE_M / 2
"""Height of a standing cube's centre."""
ROW_X_M = 0.62
SLOT_SPACING_M = 0.09

OBSERVATION_QPOS_RAD = (-0.012, -1.013, -0.388, 1.66, 0.245, 0.972, 4.401)
"""Arm configuration from which the wrist camera sees the whole row; every macro-action starts and ends here."""

HOME_QPOS_RAD = (0.0, -1.18, 0.0, 2.18, 0.0, 0.57, 3.3161)
"""Published Sawyer home configuration (gripper straight down), the posture that IK prefers."""

FRAME_PX = 64
"""Edge of an agent's frame."""

SCENE_GROUP = 0
AGENT_GROUP = 1
ARM_GROUP = 2
SETTING_GROUP = 3
CONTROL_GROUP = 4
COLLISION_GROUP = 5
"""Geom groups: loose objects; the plain table top and hands that only agents' frames show; the arm, so that a view can
leave it out; those that only views for people show (floor, legs, person, wood, smooth hands); the coarse arm that only
agents' images of continuous control show; those of contact."""

AGENT_CAMERA = "wrist"
HUMAN_CAMERA = "human"
FAR_CAMERA = "far"
HAND_CAMERA = "hand"
FRONT_CAMERA = "front"
CONTROL_CAMERAS = (HAND_CAMERA, FRONT_CAMERA)
"""Those of continuous control, in scenes that have them."""

FINGERTIP_IN_SLOT_M = (0.048, 0.0, 0.040)
"""Nominal tip of the pointing index finger relative to the centre of the cube it points at."""
