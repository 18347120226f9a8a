"""Files that outlive a run: policies, demonstrations, exported programs."""
