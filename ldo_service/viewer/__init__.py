"""Browser window with the map, camera, keyframes, objects and loop closures.

    run_folder, live     sources of a scene: the folder of a run, or a running service
    scene                content of the window as plain arrays
    lines                line drawings of the scene
    flight               camera views of objects, and camera motion to them
    panel                texts of the side panel
    window               window in the browser, made with viser

Only `window` imports viser, which is in the extra `viewer`.
"""
