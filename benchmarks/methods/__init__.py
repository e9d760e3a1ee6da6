"""Everything that plays an episode: learners, planners; and the design stage."""
