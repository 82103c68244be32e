"""From a scene file to a checked plan."""
