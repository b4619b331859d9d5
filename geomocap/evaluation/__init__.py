"""How far a run is from the truth: a synthetic capture's, or another system's markers and joints."""
