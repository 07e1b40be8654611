"""SUMO and JuPedSim as independent sources of trajectories."""
