"""The scene ``room``: the solids on a table in a textured room, taken like photographs."""
