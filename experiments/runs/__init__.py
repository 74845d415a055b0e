"""One run from its options to its finished folder: plan, execution, files, scores and figures."""
