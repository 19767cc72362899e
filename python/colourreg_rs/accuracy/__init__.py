"""How good a registration is: adjustment and tests, doubts, evaluation with and without control points, advice."""
