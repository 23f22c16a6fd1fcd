"""Commands of `ldo`, one module each; a command parses options, calls the library and prints."""
