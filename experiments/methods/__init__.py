"""The methods of transfer: what each does to an agent, and the modules it adds."""
