"""The viewer: a run in the browser, while it runs or afterwards, and as pictures without one."""
