"""Write predictions, score them, and read the directories of runs."""
