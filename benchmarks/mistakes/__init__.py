"""Inputs that can be computed with and are wrong: what ``dsr`` says of them, as a campaign."""
