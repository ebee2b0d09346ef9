"""Commands beside the bench: doctor, speed, film."""
