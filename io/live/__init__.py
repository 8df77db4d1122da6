"""Live transports: sources of messages, sinks of updates. Only here a clock may be read."""
