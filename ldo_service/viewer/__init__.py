"""Browser window with the map, camera, keyframes, objects and loop closures.

    run_folder, live     sources of a scene: a run folder, a running service
    scene                content of the window as plain arrays
    lines                line drawings of the scene
    flight               views of objects and flights to them
    panel                texts of the panel
    window               window in the browser, made with viser

Only `window` imports viser, which is in the extra `viewer`.
"""
