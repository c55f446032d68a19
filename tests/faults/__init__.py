"""Faults done to runs on purpose: `python -m tests.faults` says how many there were and what came
of them. Hours at its full numbers; the ordinary suite does a few of each (tests/test_faults.py)."""
