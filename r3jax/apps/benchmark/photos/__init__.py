"""Choice among the photos of a real capture: the pool, the choosers, the training that grows."""
