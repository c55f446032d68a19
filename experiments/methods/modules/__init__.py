"""Networks that methods add to an agent."""
