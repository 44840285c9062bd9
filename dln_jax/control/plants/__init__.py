"""Plants of any origin as four callables: adapters, safety, exploration, tuning and trials."""
