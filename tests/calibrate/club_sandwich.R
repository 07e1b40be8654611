# Standard errors and degrees of freedom of clubSandwich, for tests/calibrate/test_intervals.py:
#     Rscript tests/calibrate/club_sandwich.R > tests/calibrate/club_sandwich.json
# The rows are y, x1 (and x2), cluster; every regression has an intercept.
suppressMessages({library(clubSandwich); library(jsonlite)})

made <- function(sizes, lift = 1, third = TRUE) {
  cluster <- rep(seq_along(sizes), sizes)
  i <- seq_along(cluster)
  x1 <- round(sin(1.7 * i) + 0.4 * cluster, 3)
  x1[cluster == 1] <- round(lift * x1[cluster == 1], 3)
  x2 <- round(cos(0.9 * i) * (1 + 0.2 * cluster), 3)
  y <- round(1 + 0.5 * x1 + sin(2.3 * cluster) + 0.7 * cos(5.1 * i), 3)
  found <- data.frame(y = y, x1 = x1, cluster = cluster)
  if (third) found$x2 <- x2
  found
}

cases <- list(
  balanced = made(rep(6, 8)),
  uneven = made(c(2, 3, 4, 6, 9, 14)),
  few = made(c(7, 5, 8), third = FALSE),
  leverage = made(c(5, 4, 6, 5, 7), lift = 6)
)
results <- lapply(cases, function(one) {
  fit <- lm(if ("x2" %in% names(one)) y ~ x1 + x2 else y ~ x1, data = one)
  covariance <- vcovCR(fit, cluster = one$cluster, type = "CR2")
  test <- coef_test(fit, vcov = covariance, test = "Satterthwaite")
  list(
    data = as.list(one), covariance = unclass(as.matrix(covariance)),
    se = test$SE, df = test$df_Satt
  )
})
cat(toJSON(list(
  version = as.character(packageVersion("clubSandwich")), cases = results
), digits = 12, auto_unbox = TRUE))
