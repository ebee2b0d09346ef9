"""World models that are judged, and the reader of their images."""
