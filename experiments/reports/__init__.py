"""What came of runs: statistics, tables, figures and the page."""
