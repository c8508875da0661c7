"""C helper functions for generated code, by name."""

HELPERS = {
    "larger": """\
/* NaN, if one is NaN. */
static real larger(real a, real b) { return a > b || a != a ? a : b; }
""",
    "smaller": """\
/* NaN, if one is NaN. */
static real smaller(real a, real b) { return a < b || a != a ? a : b; }
""",
    "dense": """\
/* out = W v, four rows at a time, so that sums need not wait for each other and are not stored in between. */
static void dense(const real *restrict w, const real *restrict v, real *restrict out, int rows, int columns) {
    int i = 0;
    for (; i + 4 <= rows; i += 4, w += 4 * columns) {
        real a = 0, b = 0, c = 0, d = 0;
        for (int j = 0; j < columns; ++j) {
            a += w[j] * v[j];
            b += w[columns + j] * v[j];
            c += w[2 * columns + j] * v[j];
            d += w[3 * columns + j] * v[j];
        }
        out[i] = a;
        out[i + 1] = b;
        out[i + 2] = c;
        out[i + 3] = d;
    }
    for (; i < rows; ++i, w += columns) {
        real a = 0;
        for (int j = 0; j < columns; ++j) { a += w[j] * v[j]; }
        out[i] = a;
    }
}
""",
    "product": """\
/* out = A B, of m x k and k x n; four columns at a time, for the same reason as `dense`. */
static void product(const real *restrict a, const real *restrict b, real *restrict out, int m, int k, int n) {
    for (int i = 0; i < m; ++i, a += k, out += n) {
        int j = 0;
        for (; j + 4 <= n; j += 4) {
            const real *row = b + j;
            real p = 0, q = 0, r = 0, s = 0;
            for (int l = 0; l < k; ++l, row += n) {
                p += a[l] * row[0];
                q += a[l] * row[1];
                r += a[l] * row[2];
                s += a[l] * row[3];
            }
            out[j] = p;
            out[j + 1] = q;
            out[j + 2] = r;
            out[j + 3] = s;
        }
        for (; j < n; ++j) {
            real p = 0;
            for (int l = 0; l < k; ++l) { p += a[l] * b[l * n + j]; }
            out[j] = p;
        }
    }
}
""",
}
