"""The experiment: a rig and what was recorded on it, read from a TOML file and CSV recordings or built in Python."""
