"""The dynamic task: a scene that changes with time, from posed images of known times or from volumes."""
