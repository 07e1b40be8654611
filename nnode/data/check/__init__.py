"""What a file of trajectories holds and what is wrong with it, before anything else is done."""
