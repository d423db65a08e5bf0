"""Where a camera looks on its way from view to view: one frame at a time, or all together."""
