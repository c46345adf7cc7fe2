//! From what robots shall do to configurations that do it: goals for the search, the nearest first.
