"""The experiments of the project: trainings by name, the records that are kept of them, and the page made of those."""
