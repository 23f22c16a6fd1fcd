"""The window: a map and what is known of it, in a browser.

    run_folder, live     sources: what a run left, what a service says
    scene                what they know, as plain arrays
    lines                how it is drawn
    flight               where to look from
    panel                what is told in words
    window               the browser's side, with viser

All but `window` knows nothing of viser, which is in the extra `viewer`.
"""
