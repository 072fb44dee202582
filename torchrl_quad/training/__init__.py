"""Everything around the algorithms: configuration, building, the training loop, logging, checkpoints, pictures."""
