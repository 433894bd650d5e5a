"""The navigator: what this drone does next, and the setpoint that does it."""
