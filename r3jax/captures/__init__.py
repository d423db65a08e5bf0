"""A capture as frames of one world: how it is read and mapped, and what is wrong with it."""
