"""The ways of fitting a model of dynamics to a log: functions of settings, log, parts and context."""
