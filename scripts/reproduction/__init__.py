"""The paper's experiments, run and drawn: each problem by each optimiser at equal time."""
