"""Detection of objects in images: networks, their vocabulary, labellers, and the model registry."""
