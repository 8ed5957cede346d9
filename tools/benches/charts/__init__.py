"""Charts of choices: what each way costs against how good it is, with the Pareto front and the default marked."""
