"""Commands that are killed, run out of space and run at once, and afterwards have the results of undisturbed ones."""
