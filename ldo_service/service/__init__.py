"""The live service: its actors, the folder of its state, its metrics and diagnostics."""
