// Matrix products, transposes and means in single precision, for matrices that fit into the first cache.
//
// The order of all sums depends on the sizes alone, so that a lane of a sweep is the same run alone.

#pragma once

#include <cmath>
#include <cstring>
#include <vector>

#include "vectors.h"

namespace {

constexpr int ACCUMULATORS = V == 16 ? 20 : 12;  // vectors that a tile keeps in registers
constexpr int N = 2, W = N * V;  // vectors of hidden units, and units, that are taken at a time

#define UNROLL _Pragma("GCC unroll 16")

INLINE Vec relu(Vec v) { return v <= 0 ? Vec{} : v; }  // NaN stays

struct Left { const float* at; int64_t row, step; };  // x[r, k] is at[r row + k step]
struct Right { const float* at; int64_t row; };  // y[k, n] is at[k row + n]

// Σ_k x[r, k] y[k, n] for R rows and C vectors of columns; each is handed to finish(row, column, sum).
template <int R, int C, class Finish>
INLINE void tile(Left x, Right y, int64_t depth, int64_t row, int64_t column, Finish finish) {
  Vec sum[R][C] = {};
  const float *left = x.at + row * x.row, *right = y.at + column;
  for (int64_t k = 0; k < depth; ++k, left += x.step, right += y.row) {
    Vec loaded[C];
    UNROLL for (int n = 0; n < C; ++n) loaded[n] = load(right + n * V);
    UNROLL for (int r = 0; r < R; ++r) {
      const float factor = left[r * x.row];
      UNROLL for (int n = 0; n < C; ++n) sum[r][n] += factor * loaded[n];
    }
  }
  UNROLL for (int r = 0; r < R; ++r)
    UNROLL for (int n = 0; n < C; ++n) finish(row + r, column + n * V, sum[r][n]);
}

// A tile of at most R rows.
template <int R, int C, class Finish>
INLINE void up_to(int64_t rows, Left x, Right y, int64_t depth, int64_t row, int64_t column, Finish finish) {
  if (rows == R) return tile<R, C>(x, y, depth, row, column, finish);
  if constexpr (R > 1) up_to<R - 1, C>(rows, x, y, depth, row, column, finish);
}

// The same for all rows, in tiles of about equal height.
template <int C, class Finish>
INLINE void strip(Left x, Right y, int64_t rows, int64_t depth, int64_t column, Finish finish) {
  constexpr int most = std::min(ACCUMULATORS / C, 10);
  const int64_t tiles = (rows + most - 1) / most;
  for (int64_t i = 0; i < tiles; ++i) {
    const int64_t row = rows * i / tiles;
    up_to<most, C>(rows * (i + 1) / tiles - row, x, y, depth, row, column, finish);
  }
}

template <class Finish>
INLINE void product(Left x, Right y, int64_t rows, int64_t depth, int64_t columns, Finish finish) {
  for (int64_t column = 0; column < columns; column += V) strip<1>(x, y, rows, depth, column, finish);
}

// Transposes V rows by exchanging blocks of B × B, 2B × 2B, …
template <int B>
INLINE void exchange(Vec (&rows)[V]) {
  if constexpr (B < V) {
    for (int i = 0; i < V; ++i) {
      if (i & B) continue;
      Places low, high;
      for (int j = 0; j < V; ++j) low[j] = j & B ? V + j - B : j, high[j] = low[j] + B;
      const Vec a = rows[i], b = rows[i + B];
      rows[i] = __builtin_shuffle(a, b, low);
      rows[i + B] = __builtin_shuffle(a, b, high);
    }
    exchange<2 * B>(rows);
  }
}

// to[j, i] = from[i, j]. Where there are fewer than V rows or columns, V are read and written nevertheless.
void transpose(const float* from, int64_t from_row, float* to, int64_t to_row, int64_t rows, int64_t columns) {
  for (int64_t i = 0; i < rows; i += V)
    for (int64_t j = 0; j < columns; j += V) {
      const int64_t top = first(i, rows), left = first(j, columns);
      Vec block[V];
      for (int k = 0; k < V; ++k) block[k] = top + k < rows ? load(from + (top + k) * from_row + left) : Vec{};
      exchange<1>(block);
      for (int k = 0; k < V && left + k < columns; ++k) store(to + (left + k) * to_row + top, block[k]);
    }
}

float sum(const float* row, int64_t n) {
  Vec all{};
  int64_t i = 0;
  for (; i + V <= n; i += V) all += load(row + i);
  all += without(load(row + n - V), i + V - n);  // what is left, at the end of a vector
  return sum(all);
}

INLINE Vec inverse_root(Vec v) {
  float each[V];
  store(each, v);
  for (int j = 0; j < V; ++j) each[j] = 1 / std::sqrt(each[j]);
  return load(each);
}

// Σ_r row(r), as four sums: each addition waits for the one before.
template <class Row>
INLINE Vec over_rows(int64_t rows, Row row) {
  Vec parts[4] = {};
  int64_t r = 0;
  for (; r + 4 <= rows; r += 4)
    UNROLL for (int i = 0; i < 4; ++i) parts[i] += row(r + i);
  for (; r < rows; ++r) parts[0] += row(r);
  return (parts[0] + parts[1]) + (parts[2] + parts[3]);
}

INLINE void add(float* to, Vec v) { store(to, load(to) + v); }

// The sum of each of n vectors.
void sums(const float* vectors, int64_t n, float* to) {
  for (int64_t i = 0; i < n; i += V) {
    const int64_t at = first(i, n);
    Vec block[V], all{};
    for (int k = 0; k < V; ++k) block[k] = load(vectors + (at + k) * V);
    exchange<1>(block);
    for (int k = 0; k < V; ++k) all += block[k];
    store(to + at, all);
  }
}

// Each row of n numbers, of which N lie in a row, less its mean.
void centre(float* rows, int64_t count, int64_t n, int64_t N) {
  for (; count--; rows += N) {
    const float mean = sum(rows, n) / float(n);
    for (int64_t i = 0; i < N; i += V) store(rows + i, load(rows + i) - mean);
  }
}

// Arrays of this thread, with room for a vector behind them: the kernels are called too often to ask for memory.
enum Part {
  W1, W1T, W2T, D_W1T, BIAS, HIDDEN, ACTIVE, ROWS, REST, CENTRED, RESULT, D_RESULT, D_Z, POINT, STATE, SLOPE, SUM, INPUT,
  D_X, D_U, D_NEXT, D_SLOPE, D_POINT, SUMS, FACTORS, READ_FACTORS, PARTS
};
float* scratch(Part part, int64_t n) {
  thread_local std::vector<float> parts[PARTS];
  std::vector<float>& all = parts[part];
  if (int64_t(all.size()) < n + 2 * V) all.resize(n + 2 * V);
  return aligned(all.data());
}

}  // namespace
