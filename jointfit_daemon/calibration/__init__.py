"""Learning how sensors sit, where joints turn, and how redundant sensors combine. Pure."""
