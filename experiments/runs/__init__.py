"""Runs: what a results folder holds, how it is made, trained agents read back and used."""
