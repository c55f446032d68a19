"""Runs of populations, their evaluation and reports, and the command line."""
