"""The loop (module, problem, scorer, selection, loss, checkpoint) and the estimators."""
