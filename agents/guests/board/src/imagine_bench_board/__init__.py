"""A leaderboard without a server: rows are folders of episodes that anyone can play again."""
