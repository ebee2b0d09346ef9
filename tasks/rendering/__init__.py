"""Drawing: images of a scene from its cameras, and windows that show images."""

from .renderer import Renderer, View, close_contexts, gl_renderer

__all__ = ["Renderer", "View", "close_contexts", "gl_renderer"]
