"""What every quantity on the page means, in plain words: the tooltips."""

from r3jax.scoring.explain import CAUSES

HINTS = {
    # The view on the slider.
    "mission clock": "Time that the mission has taken so far: planning, mapping and flight. "
    "Rendering the simulator's images does not count.",
    "this view cost": "Time that this view added to the clock: planning, mapping and flight.",
    "path": "Length of the path flown so far.",
    "explored": "Share of the cells in the scene's box that are known to be free or occupied. "
    "Nothing ever shows the insides of walls and furniture, so it stays below 100 %.",
    "mean renderability": "Renderability, averaged over fixed test views in the free space that is "
    "known. 1 is perfect.",
    "R before this view": "Renderability of this very view just before it joined the map. A low "
    "value means that the view was worth taking, a high one that it repeated what was known.",
    # The camera that is dragged.
    "renderability R": "How well an image from this camera could be rendered from the views so "
    "far: 0 is not at all, 1 is perfect. R = bias x noise x resolution, averaged over the pixels.",
    "bias": "Viewing angle: 1 where a surface was seen from this very direction, falling to 0 as "
    "the nearest direction from which it was seen turns away.",
    "noise": "Color agreement: 1 where the views agree on a surface's color, less on shiny or "
    "transparent surfaces.",
    "resolution": "Closeness: 1 where some view was at least as close to the surface as this "
    "camera, less where all of them were farther away.",
    "known surface": "Share of the pixels that show a surface in the map. All other pixels count "
    "as R = 0.",
    "unexplored cells": "U_G: cells of the coarse grid in view that no view has shown yet.",
    "missing quality": "U_R: the sum of 1 - R over the voxels in view. High means that a view "
    "from here would improve much.",
    "utility this way": "Utility of looking straight ahead from here: unexplored cells (weighted "
    "by lambda1) plus missing quality.",
    "utility the best way": "The same for the best direction from this position: the ring in the "
    "picture below, and the red arrow in the scene.",
    # Candidates and causes.
    "candidates": "Poses that the planner could choose from, best score first. Score = share of "
    "the utility minus lambda2 times share of the path.",
    "promise": "Utility of the chosen view, worked out pixel by pixel and divided among four "
    "causes: unexplored cells (weighted by lambda1) plus the sum of 1 - R over the voxels in view. "
    "The planner's own number in the list above may differ, for planners estimate it faster.",
    **dict(
        zip(
            CAUSES,
            (
                "Unexplored space that the view was to show.",
                "Surfaces seen only from directions far from this view's.",
                "Surfaces whose color differed from view to view.",
                "Surfaces seen only from farther away.",
            ),
            strict=True,
        )
    ),
}
"""Tooltips by the name of the quantity on the page."""

SHOW = (
    "What is drawn. Splats, measured points and the scene mesh belong to the whole run; everything "
    "else to the view on the slider."
)
SEEN_FROM = (
    "Renderability depends on where the camera is: the mean over places in free space, or from "
    "the camera that you drag."
)
CUT = "Nothing above this height is drawn, so that you look into the rooms from above."
VIEW = "Goes through the run view by view. You can also click a camera on the path."
FOLLOW = "Goes to the newest view whenever there is one."
TURN = "Turns the camera along the red arrow: the direction of largest utility from its position."
RETURN = "Puts the camera back to where the view on the slider was taken."
TRUTH = (
    "Compares with a photo from the scene that the run was recorded in. The scene is opened for "
    "it, which takes some seconds and half a gigabyte of memory, more for large ones."
)
CANDIDATES = (
    "Draws the poses that the planner could choose from, yellow best. The planner is asked again "
    "for them, which takes as long as planning took."
)
FRUSTA = "Draws a small camera for every view up to the one on the slider."
