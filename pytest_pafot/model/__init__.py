"""What a scenario is and what is recorded of a run: values that check themselves."""
