"""Where cells are run: processes on this machine, or jobs of a Slurm cluster."""
