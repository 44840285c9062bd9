"""Ways of fitting a model of dynamics to a log, as functions of settings, log, parts and context."""
