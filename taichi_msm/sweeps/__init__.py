"""Many runs of one scene with varied values: their samples, the processes that take them, and what is made of them."""
