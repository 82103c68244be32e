"""What a run writes for each entry of a scene's `output`: one table, and the formats of its files."""
