"""Transfer of policies, trained on the Fetch in MJX, to other simulators and robots."""
