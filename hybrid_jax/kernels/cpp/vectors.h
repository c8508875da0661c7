// Vectors of V numbers in single precision, one of each of V samples, as GCC's vector extensions have them; products of
// a matrix, the same for all samples, and these; and products of two of these, summed over samples.
//
// The order of all sums depends on the sizes alone, so that a lane of a sweep is the same run alone.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <type_traits>
#include <vector>

namespace {

// What registers hold beside vectors of V numbers: rows of a product with a vector; and rows and columns of a sum of
// products.
constexpr int DENSE = V == 16 ? 20 : 8, ROWS = V == 16 ? 4 : 3, COLUMNS = V == 16 ? 6 : 3;

#define INLINE inline __attribute__((always_inline))
#define UNROLL _Pragma("GCC unroll 20")
typedef float Vec __attribute__((vector_size(4 * V), aligned(4), may_alias));
typedef int32_t Places __attribute__((vector_size(4 * V)));
#define HELD alignas(sizeof(Vec))  // a vector that begins within a line of the cache takes two accesses

INLINE Vec load(const float* from) { return *reinterpret_cast<const Vec*>(from); }
INLINE void store(float* to, Vec v) { *reinterpret_cast<Vec*>(to) = v; }
// The first n numbers; the last of them repeats.
INLINE Vec load(const float* from, int64_t n) {
  if (n >= V) return load(from);
  Vec v;
  for (int j = 0; j < V; ++j) v[j] = from[std::min<int64_t>(j, n - 1)];
  return v;
}
INLINE void store(float* to, Vec v, int64_t n) {
  if (n >= V) store(to, v);
  else std::copy_n(reinterpret_cast<const float*>(&v), n, to);
}
INLINE Vec* vectors(float* at) {
  return reinterpret_cast<Vec*>((reinterpret_cast<uintptr_t>(at) + sizeof(Vec) - 1) & -sizeof(Vec));
}

// v with zeros behind its first n numbers.
INLINE Vec first(Vec v, int64_t n) {
  Places place;
  for (int j = 0; j < V; ++j) place[j] = j;
  return place < int32_t(n) ? v : Vec{};
}

template <int HALF = V / 2>
INLINE float sum(Vec v) {
  Places place;
  for (int j = 0; j < V; ++j) place[j] = j ^ HALF;
  v += __builtin_shuffle(v, place);
  if constexpr (HALF > 1) return sum<HALF / 2>(v);
  return v[0];
}

// M rows in tiles of about equal height, of R or of R − 1 rows.
template <int M, int MOST, class Do>
INLINE void in_tiles(Do of) {
  constexpr int count = M ? (M + MOST - 1) / MOST : 1, R = (M + count - 1) / count, large = M - count * (R - 1);
  int i = 0;
  for (int k = 0; k < large; ++k, i += R) of(std::integral_constant<int, R>{}, i);
  if constexpr (R > 1)
    for (; i < M; i += R - 1) of(std::integral_constant<int, R - 1>{}, i);
}

// out = W v of M rows and K columns, with W[i, k] at w[i row + k step].
template <int M, int K, class W, class X>
INLINE void dense(const W* w, int64_t row, int64_t step, X v, Vec* out) {
  in_tiles<M, DENSE>([&](auto rows, int i) __attribute__((always_inline)) {
    constexpr int R = decltype(rows)::value;
    Vec sum[R] = {};
    const W* at = w + i * row;
    _Pragma("GCC unroll 4") for (int k = 0; k < K; ++k, at += step) {
      const Vec one = v[k];
      UNROLL for (int r = 0; r < R; ++r) sum[r] += at[r * row] * one;
    }
    UNROLL for (int r = 0; r < R; ++r) out[i + r] = sum[r];
  });
}

// sums += Σ a bᵀ over slots, of M rows and N columns, so many vectors apart; the next a and b lie so many behind the last.
// The longer gives the rows, as it is read once.
template <int M, int N, int ROW = N, int COLUMN = 1>
void add_products(Vec* sums, const Vec* a, int64_t next_a, const Vec* b, int64_t next_b, int64_t slots) {
  if constexpr (M < N) add_products<N, M, COLUMN, ROW>(sums, b, next_b, a, next_a, slots);
  else in_tiles<M, ROWS>([&](auto rows, int i) __attribute__((always_inline)) {
    in_tiles<N, COLUMNS>([&](auto columns, int j) __attribute__((always_inline)) {
      constexpr int R = decltype(rows)::value, C = decltype(columns)::value;
      Vec sum[R][C], *at = sums + i * ROW + j * COLUMN;
      UNROLL for (int r = 0; r < R; ++r) UNROLL for (int c = 0; c < C; ++c) sum[r][c] = at[r * ROW + c * COLUMN];
      for (int64_t s = 0; s < slots; ++s)
        UNROLL for (int r = 0; r < R; ++r)
          UNROLL for (int c = 0; c < C; ++c) sum[r][c] += a[s * next_a + i + r] * b[s * next_b + j + c];
      UNROLL for (int r = 0; r < R; ++r) UNROLL for (int c = 0; c < C; ++c) at[r * ROW + c * COLUMN] = sum[r][c];
    });
  });
}

// Memory of this thread, handed out in the same order each time: kernels are called too often to ask for it.
struct Room {
  size_t taken = 0;
  Vec* operator()(int64_t n) {
    thread_local std::vector<std::vector<float>> parts;
    if (taken == parts.size()) parts.emplace_back();
    std::vector<float>& part = parts[taken++];
    if (int64_t(part.size()) < (n + 1) * V) part.resize((n + 1) * V);
    return vectors(part.data());
  }
};

}  // namespace
