"""Drawing: OpenGL's platform, images of a scene from its cameras, and windows that show images."""
