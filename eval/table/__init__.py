"""The paper's experiment: objects, policies, estimators and truths in one table."""
