"""Expert trajectories: the container, our file format, and readers of other projects' files.

Nothing that is read from a file is trusted, and no code in a file is ever run.
"""
