"""Real trainings on real engines, on one machine: see `python -m tests.engines --help`."""
