"""Evaluation study: the results of the AMI-EV paper, measured on simulated worlds with ground truth."""
