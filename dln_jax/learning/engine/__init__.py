"""The optimisers' loops: resumable at any dispatch, the best parameters by validation."""
