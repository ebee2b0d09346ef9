"""Inverse kinematics by motor babbling (thesis 4.5.2)."""
