"""The verbs of `ldo`, one file each. A verb parses, calls the library, prints."""
