"""Commands of `ldo`, one module each, which parse options, call the library and print."""
