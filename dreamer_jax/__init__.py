"""Dreamer (version 1) from pixels as pure, jitted functions over populations of agents."""
