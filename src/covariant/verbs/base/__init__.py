"""What verbs share: the model and the log as they are read, the run of an observer, results and their pages."""
