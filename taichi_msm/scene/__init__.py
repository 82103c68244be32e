"""The scene: one frozen pydantic model for each section of the YAML file."""
