// Vectors of V numbers in single precision, as GCC's vector extensions have them.

#pragma once

#include <algorithm>
#include <cstdint>

#include "arrays.h"

namespace {

#if defined(__AVX512F__)
constexpr int V = 16;  // numbers in a vector
#else
constexpr int V = 8;
#endif

#define INLINE inline __attribute__((always_inline))
typedef float Vec __attribute__((vector_size(4 * V), aligned(4), may_alias));
typedef int32_t Places __attribute__((vector_size(4 * V)));

// A vector that begins within a line of the cache takes two accesses.
#define HELD alignas(sizeof(Vec))
INLINE float* aligned(float* at) {
  return reinterpret_cast<float*>((reinterpret_cast<uintptr_t>(at) + sizeof(Vec) - 1) & -sizeof(Vec));
}

INLINE Vec load(const float* from) { return *reinterpret_cast<const Vec*>(from); }
INLINE void store(float* to, Vec v) { *reinterpret_cast<Vec*>(to) = v; }

// The first of V rows or columns from i on: the last overlap those before, so that no vector is cut where there are V.
INLINE int64_t first(int64_t i, int64_t n) { return std::max<int64_t>(0, std::min(i, n - V)); }

// v without its first n numbers.
INLINE Vec without(Vec v, int64_t n) {
  Places place;
  for (int j = 0; j < V; ++j) place[j] = j;
  return place >= int32_t(n) ? v : Vec{};
}

INLINE float sum(Vec v) {
  float part[V];
  store(part, v);
  for (int half = V / 2; half; half /= 2)
    for (int j = 0; j < half; ++j) part[j] += part[j + half];
  return part[0];
}

}  // namespace
