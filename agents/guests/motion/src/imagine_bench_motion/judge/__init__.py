"""Models of motions, judged by the simulator."""
