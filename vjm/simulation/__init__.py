"""Open-loop simulation of recordings, its derivatives, and most likely initial states."""
