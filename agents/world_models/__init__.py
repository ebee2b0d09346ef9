"""World models that are judged, and the reader of what they imagine."""
