"""The factor graph of keyframes. gtsam is imported in this package and nowhere else: it holds the
GIL during every call, so whoever imports it runs in a process of its own."""
