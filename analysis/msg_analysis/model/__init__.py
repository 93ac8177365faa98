"""What an experiment is: file, graphs, chain, noise, the law of one step, the record and the outcome of a run."""
