"""The paper's studies on the real recordings: tasks, statistics, pages."""
