"""Files on disk, written whole or not at all: states, arrays, checksummed folders, YAML."""
