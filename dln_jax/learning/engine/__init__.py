"""The one loop of all trainings: `fit`, its optimisers as records, and how a run is stored."""
