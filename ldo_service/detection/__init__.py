"""Networks that find and name objects in images, their vocabulary, and the model registry."""
