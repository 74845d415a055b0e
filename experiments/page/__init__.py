"""The page of a report: its HTML document, the runs on it, and drawings of episodes."""
