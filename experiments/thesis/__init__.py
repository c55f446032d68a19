"""The thesis's grid of agents: tables, figures, the runs behind them, and their training."""
