"""The scene, with a frozen pydantic model for each section of the YAML file."""
