"""The classes of the flat: those of COCO in their usual order, others, and the building."""

# Lin et al., ECCV 2014; numbered 0-79 as detectors number them.
COCO = (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant "
    "stop_sign parking_meter bench bird cat dog horse sheep cow elephant bear zebra giraffe "
    "backpack umbrella handbag tie suitcase frisbee skis snowboard sports_ball kite baseball_bat "
    "baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork knife spoon bowl "
    "banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch "
    "potted_plant bed dining_table toilet tv laptop mouse remote keyboard cell_phone microwave "
    "oven toaster sink refrigerator book clock vase scissors teddy_bear hair_drier toothbrush"
)
OTHERS = (
    "fire_extinguisher whiteboard projector radiator ladder broom bucket cardboard_box lamp shelf "
    "door picture_frame toolbox speaker printer cabinet rug trash_can window coat_rack globe "
    "cushion fan"
)
BUILDING = "wall floor ceiling"

CLASS_NAMES = tuple(name.replace("_", " ") for name in f"{COCO} {OTHERS} {BUILDING}".split())
COCO_COUNT = len(COCO.split())
WALL, FLOOR, CEILING = (CLASS_NAMES.index(name) for name in BUILDING.split())
