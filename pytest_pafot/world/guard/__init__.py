"""Protection against failures of the user's code: a time limit on decisions, and the record of a failed decision."""
