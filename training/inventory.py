"""Classes of objects by location in a room.

Objects are placed in the order of these lists, which begin with large objects. A class that is
listed twice may occur twice in a room.
"""

SHAPES = {  # Number of shapes of each class; one for classes that are not listed.
    "chair": 3, "couch": 2, "dining table": 3, "shelf": 2, "cabinet": 2, "cushion": 2, "rug": 2,
    "lamp": 3, "potted plant": 3, "tv": 2, "speaker": 2, "bottle": 2, "cup": 2, "vase": 2,
    "suitcase": 2, "cardboard box": 2, "trash can": 2, "book": 3, "clock": 2, "picture frame": 3,
}  # fmt: skip

AT_WALLS = (
    "bed", "couch", "couch", "dining table", "cabinet", "cabinet", "dining table", "shelf", "shelf",
    "refrigerator", "oven", "sink", "toilet", "radiator", "bench", "door", "ladder", "broom",
    "skateboard", "coat rack", "umbrella", "fire extinguisher", "fan", "lamp", "speaker",
    "suitcase", "printer",
    "potted plant", "trash can", "projector", "cardboard box", "toolbox", "bucket", "backpack",
    "chair", "handbag", "tv", "teddy bear",
)  # fmt: skip
HUNG = {  # Range of the height of the object's center, meters.
    "window": (1.4, 1.55), "whiteboard": (1.35, 1.6), "picture frame": (1.5, 2.0),
    "clock": (1.5, 2.0), "tv": (1.0, 1.4),
}  # fmt: skip
ON_THE_FLOOR = (
    "dining table", "dining table", "chair", "chair", "chair", "rug", "potted plant", "suitcase",
    "backpack", "handbag", "sports ball", "cardboard box", "bucket", "toolbox", "trash can",
    "projector", "fan", "coat rack", "lamp", "bench", "teddy bear", "cushion",
)  # fmt: skip
ON_TABLES = (
    "laptop", "cup", "bottle", "book", "cell phone", "vase", "keyboard", "mouse", "remote", "bowl",
    "apple", "orange", "banana", "wine glass", "lamp", "microwave", "toaster", "printer", "tv",
    "globe", "speaker", "teddy bear", "toolbox", "handbag", "clock",
)  # fmt: skip
ON_SEATS = ("cushion", "cushion", "teddy bear", "remote", "book", "cell phone", "handbag", "laptop")
IN_SHELVES = ("book", "book", "book", "speaker", "vase", "globe", "handbag", "clock", "bowl", "cup")
FLAT_SHAPES = {"tv": 1}  # Shape number of objects on walls.
LYING = {  # Shape numbers of objects on tables, seats and shelves.
    "lamp": (1, 2),
    "speaker": (1,),
    "tv": (0,),
    "cabinet": (0, 1),
}
STANDING = {"lamp": (0,), "speaker": (0,)}  # Shape numbers of objects on the floor.
ON_SHELVES = ("vase", "globe", "printer", "clock", "book")
TABLES = ("dining table", "cabinet")
SEATS_M = {"couch": 0.48, "bed": 0.51, "bench": 0.45}  # Heights of the seats.
BOARDS_M = {  # Heights of the boards of tall (True) and low (False) shelves.
    True: (0.105, 0.445, 0.785, 1.125, 1.465),
    False: (0.085, 0.425),
}
