// CPU operators of the trainer: kernel maps, sparse convolution and the Gaussian splatter, forward and backward.
// Everything is deterministic for any number of threads: a task owns the rows it writes, and sums over rows are
// taken over a fixed number of parts and added in order.
#include <immintrin.h>
#include <torch/extension.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <vector>

#if defined(__AMX_BF16__) && defined(__AVX512BF16__)
#define HAS_AMX 1
#include "amx.h"
#endif

using torch::Tensor;

namespace {

constexpr int64_t BLOCK = 256;  // output rows of one convolution task: its accumulators stay in the L2 cache
constexpr int64_t PARTS = 16;   // parts of a sum over rows

void check(const Tensor& t, at::ScalarType type) {
  TORCH_CHECK(t.is_contiguous() && t.device().is_cpu() && t.scalar_type() == type, "expected a contiguous CPU tensor");
}

// ---------------------------------------------------------------------------------------------------------------
// Kernel maps

uint64_t key_of(int64_t x, int64_t y, int64_t z) {
  return (uint64_t(x + 1) << 42) | (uint64_t(y + 1) << 21) | uint64_t(z + 1);
}

struct Table {
  std::vector<uint64_t> keys;
  std::vector<int32_t> values;
  uint64_t mask;
  static uint64_t hash(uint64_t k) { return (k * 0x9E3779B97F4A7C15ull) >> 24; }
  explicit Table(const Tensor& coords) {
    const int64_t n = coords.size(0);
    const int32_t* c = coords.data_ptr<int32_t>();
    uint64_t size = 16;
    while (size < uint64_t(n) * 2) size *= 2;
    mask = size - 1;
    keys.assign(size, 0);
    values.resize(size);
    for (int64_t i = 0; i < n; i++) {
      const uint64_t k = key_of(c[3 * i], c[3 * i + 1], c[3 * i + 2]);
      uint64_t h = hash(k) & mask;
      while (keys[h]) h = (h + 1) & mask;
      keys[h] = k;
      values[h] = int32_t(i);
    }
  }
  int32_t find(uint64_t k) const {
    for (uint64_t h = hash(k) & mask; keys[h]; h = (h + 1) & mask)
      if (keys[h] == k) return values[h];
    return -1;
  }
};

// map[k][i] = row of coords[i] + offsets[k], or -1. Coordinates must be >= 0 and < 2^20.
Tensor kernel_map(const Tensor& coords, const Tensor& offsets) {
  check(coords, at::kInt);
  check(offsets, at::kInt);
  const int64_t n = coords.size(0), taps = offsets.size(0);
  const Table table(coords);
  Tensor map = torch::empty({taps, n}, torch::kInt);
  const int32_t *c = coords.data_ptr<int32_t>(), *o = offsets.data_ptr<int32_t>();
  int32_t* m = map.data_ptr<int32_t>();
  for (int64_t k = 0; k < taps; k++) {
    const bool self = !o[3 * k] && !o[3 * k + 1] && !o[3 * k + 2];
    for (int64_t i = 0; i < n; i++)
      m[k * n + i] = self ? int32_t(i) : table.find(key_of(c[3 * i] + o[3 * k], c[3 * i + 1] + o[3 * k + 1], c[3 * i + 2] + o[3 * k + 2]));
  }
  return map;
}

// The 3x3x3 map of the level below one whose 3x3x3 map is `above`; child[o][p] = row of child o of row p, or -1; taps x fastest.
Tensor child_map(const Tensor& above, const Tensor& child, const Tensor& parent, const Tensor& coords) {
  for (const Tensor* t : {&above, &child, &parent, &coords}) check(*t, at::kInt);
  const int64_t n = coords.size(0), np = above.size(1);
  TORCH_CHECK(above.size(0) == 27 && child.size(0) == 8 && child.size(1) == np && parent.size(0) == n, "levels do not agree");
  Tensor map = torch::empty({27, n}, torch::kInt);
  const int32_t *a = above.data_ptr<int32_t>(), *ch = child.data_ptr<int32_t>(), *pp = parent.data_ptr<int32_t>(), *c = coords.data_ptr<int32_t>();
  int32_t* m = map.data_ptr<int32_t>();
  int tap[8][27], octant[8][27];
  for (int o = 0; o < 8; o++)
    for (int k = 0; k < 27; k++) {
      tap[o][k] = octant[o][k] = 0;
      for (int axis = 0, three = 1, offset = k; axis < 3; axis++, three *= 3, offset /= 3) {
        const int at = (o >> axis & 1) + offset % 3 - 1;
        tap[o][k] += three * (1 + (at < 0 ? -1 : at > 1 ? 1 : 0));
        octant[o][k] |= (at & 1) << axis;
      }
    }
  for (int64_t i = 0; i < n; i++) {
    const int o = (c[3 * i] & 1) | (c[3 * i + 1] & 1) << 1 | (c[3 * i + 2] & 1) << 2;
    for (int k = 0; k < 27; k++) {
      const int32_t p = a[tap[o][k] * np + pp[i]];
      m[k * n + i] = p < 0 ? -1 : ch[octant[o][k] * np + p];
    }
  }
  return map;
}

// ---------------------------------------------------------------------------------------------------------------
// Sparse convolution: out[i] = sum_k W_k x[map[k][i]]

struct Aligned {
  float* p;
  explicit Aligned(int64_t n) : p(static_cast<float*>(std::aligned_alloc(64, (n * 4 + 63) / 64 * 64))) {}
  ~Aligned() { std::free(p); }
  Aligned(const Aligned&) = delete;
};

// Weights as panels of 16 output columns: [tap][panel][in][16], zero beyond the last column.
void pack(const float* w, int64_t taps, int64_t cin, int64_t cout, bool transpose, float* out) {
  const int64_t panels = (cout + 15) / 16;
#pragma omp parallel for schedule(static)
  for (int64_t k = 0; k < taps; k++)
    for (int64_t p = 0; p < panels; p++)
      for (int64_t c = 0; c < cin; c++)
        for (int64_t j = 0; j < 16; j++) {
          const int64_t o = p * 16 + j;
          const float v = o >= cout ? 0.f : transpose ? w[(k * cout + o) * cin + c] : w[(k * cin + c) * cout + o];
          out[((k * panels + p) * cin + c) * 16 + j] = v;
        }
}

template <int R>
inline void tile(const float* const* x, float* const* y, const float* w, int64_t cin) {
  __m256 a[R][2];
#pragma GCC unroll 8
  for (int r = 0; r < R; r++) {
    a[r][0] = _mm256_load_ps(y[r]);
    a[r][1] = _mm256_load_ps(y[r] + 8);
  }
  for (int64_t c = 0; c < cin; c++) {
    const __m256 w0 = _mm256_load_ps(w + 16 * c), w1 = _mm256_load_ps(w + 16 * c + 8);
#pragma GCC unroll 8
  for (int r = 0; r < R; r++) {
      const __m256 b = _mm256_broadcast_ss(x[r] + c);
      a[r][0] = _mm256_fmadd_ps(b, w0, a[r][0]);
      a[r][1] = _mm256_fmadd_ps(b, w1, a[r][1]);
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < R; r++) {
    _mm256_store_ps(y[r], a[r][0]);
    _mm256_store_ps(y[r] + 8, a[r][1]);
  }
}

void tiles(const float* const* x, float* const* y, const float* w, int64_t cin, int64_t n) {
  int64_t i = 0;
  for (; i + 6 <= n; i += 6) tile<6>(x + i, y + i, w, cin);
  switch (n - i) {
    case 1: tile<1>(x + i, y + i, w, cin); break;
    case 2: tile<2>(x + i, y + i, w, cin); break;
    case 3: tile<3>(x + i, y + i, w, cin); break;
    case 4: tile<4>(x + i, y + i, w, cin); break;
    case 5: tile<5>(x + i, y + i, w, cin); break;
    default: break;
  }
}

// ---------------------------------------------------------------------------------------------------------------
// The same products from operands rounded to bf16, summed in f32: twice as fast where the processor has the instruction.

bool use_bf16 = false;

#ifdef __AVX512BF16__
constexpr bool HAS_BF16 = true;

struct Halves {
  uint16_t* p;
  int64_t stride;  // a multiple of 16; zero beyond the last channel
  Halves(const float* x, int64_t n, int64_t c) : stride((c + 15) / 16 * 16) {
    p = static_cast<uint16_t*>(std::aligned_alloc(64, ((n + 1) * stride * 2 + 63) / 64 * 64));
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n; i++)
      for (int64_t j = 0; j < stride; j += 16) {
        const __mmask16 m = c - j >= 16 ? 0xffff : __mmask16((1u << (c - j)) - 1);
        const __m512 v = _mm512_maskz_loadu_ps(m, x + i * c + j);
        _mm256_store_si256(reinterpret_cast<__m256i*>(p + i * stride + j), (__m256i)_mm512_cvtneps_pbh(v));
      }
    std::fill(p + n * stride, p + (n + 1) * stride, uint16_t(0));
  }
  ~Halves() { std::free(p); }
  Halves(const Halves&) = delete;
  const uint16_t* row(int64_t i) const { return p + i * stride; }
};

uint16_t to_bf16(float v) {
  uint32_t u;
  std::memcpy(&u, &v, 4);
  return uint16_t((u + 0x7fff + ((u >> 16) & 1)) >> 16);
}

// Weights as [tap][group of 64 columns][pair of inputs][up to 4 panels][16 columns][2 inputs].
void pack_halves(const float* w, int64_t taps, int64_t cin, int64_t cout, bool transpose, uint16_t* out) {
  const int64_t panels = (cout + 15) / 16, pairs = (cin + 1) / 2;
#pragma omp parallel for schedule(static)
  for (int64_t k = 0; k < taps; k++) {
    uint16_t* to = out + k * panels * pairs * 32;
    for (int64_t first = 0; first < panels; first += 4)
      for (int64_t c = 0; c < pairs; c++)
        for (int64_t p = first; p < std::min(first + 4, panels); p++)
          for (int64_t j = 0; j < 32; j++) {
            const int64_t o = p * 16 + j / 2, i = 2 * c + j % 2;
            *to++ = o >= cout || i >= cin ? 0 : to_bf16(transpose ? w[(k * cout + o) * cin + i] : w[(k * cin + i) * cout + o]);
          }
  }
}

__m512bh pair_of(const uint16_t* p) {
  int32_t v;
  std::memcpy(&v, p, 4);
  return (__m512bh)_mm512_set1_epi32(v);
}

// R rows by P panels: y += x w.
template <int R, int P>
void tile_halves(const uint16_t* const* x, float* const* y, const uint16_t* w, int64_t pairs) {
  __m512 a[R][P];
#pragma GCC unroll 32
  for (int r = 0; r < R; r++)
#pragma GCC unroll 4
    for (int p = 0; p < P; p++) a[r][p] = _mm512_loadu_ps(y[r] + 16 * p);
  for (int64_t c = 0; c < pairs; c++) {
    __m512bh v[P];
#pragma GCC unroll 4
    for (int p = 0; p < P; p++) v[p] = (__m512bh)_mm512_loadu_si512(w + (c * P + p) * 32);
#pragma GCC unroll 32
    for (int r = 0; r < R; r++) {
      const __m512bh b = pair_of(x[r] + 2 * c);
#pragma GCC unroll 4
      for (int p = 0; p < P; p++) a[r][p] = _mm512_dpbf16_ps(a[r][p], v[p], b);
    }
  }
#pragma GCC unroll 32
  for (int r = 0; r < R; r++)
#pragma GCC unroll 4
    for (int p = 0; p < P; p++) _mm512_storeu_ps(y[r] + 16 * p, a[r][p]);
}

template <int R, int P>
void rows_halves(const uint16_t* const* x, float* const* y, const uint16_t* w, int64_t pairs, int64_t n) {
  int64_t i = 0;
  for (; i + R <= n; i += R) tile_halves<R, P>(x + i, y + i, w, pairs);
  if constexpr (R > 1) rows_halves<R / 2, P>(x + i, y + i, w, pairs, n - i);
}

void tiles_halves(const uint16_t* const* x, float* const* y, const uint16_t* w, int64_t pairs, int64_t panels, int64_t n) {
  switch (panels) {
    case 1: rows_halves<16, 1>(x, y, w, pairs, n); break;
    case 2: rows_halves<12, 2>(x, y, w, pairs, n); break;
    case 3: rows_halves<8, 3>(x, y, w, pairs, n); break;
    default: rows_halves<6, 4>(x, y, w, pairs, n); break;
  }
}

// dw[R][P panels] += sum over steps of x^T g; a step is a pair of rows, interleaved.
template <int R, int P>
void outer_halves(const uint16_t* x, int64_t sx, const uint16_t* g, int64_t sg, float* dw, int64_t sw, int64_t steps) {
  __m512 a[R][P];
#pragma GCC unroll 8
  for (int r = 0; r < R; r++)
#pragma GCC unroll 4
    for (int p = 0; p < P; p++) a[r][p] = _mm512_loadu_ps(dw + r * sw + 16 * p);
  for (int64_t i = 0; i < steps; i++) {
    __m512bh v[P];
#pragma GCC unroll 4
    for (int p = 0; p < P; p++) v[p] = (__m512bh)_mm512_loadu_si512(g + i * sg + 32 * p);
#pragma GCC unroll 8
    for (int r = 0; r < R; r++) {
      const __m512bh b = pair_of(x + i * sx + 2 * r);
#pragma GCC unroll 4
      for (int p = 0; p < P; p++) a[r][p] = _mm512_dpbf16_ps(a[r][p], v[p], b);
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < R; r++)
#pragma GCC unroll 4
    for (int p = 0; p < P; p++) _mm512_storeu_ps(dw + r * sw + 16 * p, a[r][p]);
}

// Two rows, element by element, side by side.
void interleave(const uint16_t* a, const uint16_t* b, int64_t stride, uint16_t* to) {
  for (int64_t j = 0; j < stride; j += 16) {
    const __m512i lo = _mm512_cvtepu16_epi32(_mm256_load_si256(reinterpret_cast<const __m256i*>(a + j)));
    const __m512i hi = _mm512_cvtepu16_epi32(_mm256_load_si256(reinterpret_cast<const __m256i*>(b + j)));
    _mm512_storeu_si512(to + 2 * j, _mm512_or_si512(lo, _mm512_slli_epi32(hi, 16)));
  }
}

Tensor weight_grad_halves(const Tensor& x, const Tensor& g, const Tensor& map) {
  constexpr int64_t CHUNK = 128, SHARES = 8;
  const int64_t taps = map.size(0), n = map.size(1), cin = x.size(1), cout = g.size(1);
  const Halves xh(x.data_ptr<float>(), x.size(0), cin), gh(g.data_ptr<float>(), n, cout);
  const int64_t wide = gh.stride, deep = xh.stride, size = deep * wide;
  Aligned acc(SHARES * taps * size);
  const int32_t* mp = map.data_ptr<int32_t>();
#pragma omp parallel
  {
    std::vector<uint16_t> gs(CHUNK * wide + 32), xs(CHUNK * deep + 32);
    int32_t ins[BLOCK + 1], outs[BLOCK + 1];
#pragma omp for schedule(dynamic, 1)
    for (int64_t share = 0; share < SHARES; share++) {
      float* mine = acc.p + share * taps * size;
      std::fill(mine, mine + taps * size, 0.f);
      const int64_t stop = n * (share + 1) / SHARES;
      for (int64_t r0 = n * share / SHARES; r0 < stop; r0 += BLOCK) {
        const int64_t r1 = std::min(stop, r0 + BLOCK);
        for (int64_t k = 0; k < taps; k++) {
          int64_t pairs = 0;
          for (int64_t i = r0; i < r1; i++) {
            ins[pairs] = mp[k * n + i];
            outs[pairs] = int32_t(i);
            pairs += ins[pairs] >= 0;
          }
          if (pairs % 2) {  // the row of zeros makes the last pair whole
            ins[pairs] = int32_t(x.size(0));
            outs[pairs++] = int32_t(n);
          }
          for (int64_t first = 0; first < pairs; first += CHUNK) {
            const int64_t steps = std::min(CHUNK, pairs - first) / 2;
            for (int64_t j = 0; j < steps; j++) {
              interleave(xh.row(ins[first + 2 * j]), xh.row(ins[first + 2 * j + 1]), deep, xs.data() + j * 2 * deep);
              interleave(gh.row(outs[first + 2 * j]), gh.row(outs[first + 2 * j + 1]), wide, gs.data() + j * 2 * wide);
            }
            for (int64_t o = 0; o < wide; o += 64)
              for (int64_t c = 0; c < cin; c += 4) {
                float* to = mine + k * size + c * wide + o;
                const uint16_t *xa = xs.data() + 2 * c, *ga = gs.data() + 2 * o;
                switch (std::min<int64_t>(4, (wide - o) / 16)) {
                  case 1: outer_halves<4, 1>(xa, 2 * deep, ga, 2 * wide, to, wide, steps); break;
                  case 2: outer_halves<4, 2>(xa, 2 * deep, ga, 2 * wide, to, wide, steps); break;
                  case 3: outer_halves<4, 3>(xa, 2 * deep, ga, 2 * wide, to, wide, steps); break;
                  default: outer_halves<4, 4>(xa, 2 * deep, ga, 2 * wide, to, wide, steps); break;
                }
              }
          }
        }
      }
    }
  }
  Tensor dw = torch::empty({taps, cin, cout});
  float* dp = dw.data_ptr<float>();
#pragma omp parallel for schedule(static)
  for (int64_t k = 0; k < taps; k++)
    for (int64_t c = 0; c < cin; c++)
      for (int64_t o = 0; o < cout; o++) {
        float sum = 0;
        for (int64_t share = 0; share < SHARES; share++) sum += acc.p[(share * taps + k) * size + c * wide + o];
        dp[(k * cin + c) * cout + o] = sum;
      }
  return dw;
}
#else
constexpr bool HAS_BF16 = false;
#endif

// Whether convolutions round their operands to bf16; returns what holds: false where the processor cannot.
bool set_bf16(bool on) { return use_bf16 = on && HAS_BF16; }

bool use_amx() {
#ifdef HAS_AMX
  return use_bf16 && amx::granted();
#else
  return false;
#endif
}

// What products read: on AMX the rows in bf16, padded as `taps` call for; x itself elsewhere.
Tensor rows(const Tensor& x, int64_t taps) {
#ifdef HAS_AMX
  if (use_amx()) {
    check(x, at::kFloat);
    const int64_t n = x.size(0), c = x.size(1), stride = amx::Packing(taps, c).wide;
    Tensor out = torch::empty({amx::Rows::size(n, stride)}, torch::kBFloat16);
    amx::Rows to(static_cast<uint16_t*>(out.data_ptr()), n, stride);
    const float* xp = x.data_ptr<float>();
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n; i++) to.set(i, xp + i * c, c);
    return out;
  }
#endif
  return x;
}

// Plain: y = relu?(conv + bias). With a gain, the geometry-invariant form: y = relu?(gain * conv * r + bias),
// r = 1 / sqrt(sum of squared active weights + 1e-8); returns y, conv * r and r, which the backward pass needs.
std::vector<Tensor> conv(const Tensor& x, const Tensor& w, bool transpose, const Tensor& map, const c10::optional<Tensor>& bias,
                         const c10::optional<Tensor>& gain, bool relu) {
  check(w, at::kFloat);
  check(map, at::kInt);
  const int64_t taps = map.size(0), n = map.size(1);
  const int64_t cin = w.size(transpose ? 2 : 1), cout = w.size(transpose ? 1 : 2), panels = (cout + 15) / 16, wide = panels * 16;
  [[maybe_unused]] const int64_t pairs = (cin + 1) / 2;
  TORCH_CHECK(w.size(0) == taps, "convolution shapes do not agree");
  const bool norm = gain.has_value();
  Tensor y = torch::empty({n, cout}), hat, inv;
  if (norm) {
    hat = torch::empty({n, cout});
    inv = torch::empty({n, cout});
  }
  Aligned squares(norm ? taps * wide : 1);
  if (norm) {
    std::fill(squares.p, squares.p + taps * wide, 0.f);
    const float* wp = w.data_ptr<float>();
    for (int64_t k = 0; k < taps; k++)
      for (int64_t c = 0; c < cin; c++)
        for (int64_t o = 0; o < cout; o++) {
          const float v = transpose ? wp[(k * cout + o) * cin + c] : wp[(k * cin + c) * cout + o];
          squares.p[k * wide + o] += v * v;
        }
  }
  const float *bp = bias ? bias->data_ptr<float>() : nullptr, *gp = norm ? gain->data_ptr<float>() : nullptr;
  float *yp = y.data_ptr<float>(), *hp = norm ? hat.data_ptr<float>() : nullptr, *ip = norm ? inv.data_ptr<float>() : nullptr;
  const int32_t* mp = map.data_ptr<int32_t>();
#ifdef HAS_AMX
  if (x.scalar_type() == at::kBFloat16) {
    TORCH_CHECK(taps <= 32, "more taps than a mask holds");
    amx::convolve(amx::Rows(static_cast<const uint16_t*>(x.data_ptr()), amx::Packing(taps, cin).wide), cin, w.data_ptr<float>(), transpose, mp, taps, squares.p, {n, cout, panels, bp, gp, relu, yp, hp, ip});
    if (norm) return {y, hat, inv};
    return {y};
  }
#endif
  check(x, at::kFloat);
  TORCH_CHECK(x.size(1) == cin, "convolution shapes do not agree");
  const float* xp = x.data_ptr<float>();
  Aligned packed(taps * panels * (cin + 1) * 16);
#ifdef __AVX512BF16__
  uint16_t* halves = reinterpret_cast<uint16_t*>(packed.p);
  const Halves xh(x.data_ptr<float>(), use_bf16 ? x.size(0) : 0, cin);
  if (use_bf16) pack_halves(w.data_ptr<float>(), taps, cin, cout, transpose, halves);
#endif
  if (!use_bf16) pack(w.data_ptr<float>(), taps, cin, cout, transpose, packed.p);
  const int64_t blocks = (n + BLOCK - 1) / BLOCK;
#pragma omp parallel
  {
    Aligned acc(panels * BLOCK * 16), den(norm ? BLOCK * wide : 1);
    const float* rows[BLOCK];
#ifdef __AVX512BF16__
    const uint16_t* narrow[BLOCK];
#endif
    float* outs[BLOCK];
    int32_t local[BLOCK];
#pragma omp for schedule(dynamic, 1)
    for (int64_t b = 0; b < blocks; b++) {
      const int64_t r0 = b * BLOCK, m = std::min(BLOCK, n - r0);
      std::fill(acc.p, acc.p + m * wide, 0.f);
      if (norm) std::fill(den.p, den.p + m * wide, 0.f);
      for (int64_t k = 0; k < taps; k++) {
        const int32_t* nb = mp + k * n + r0;
        int64_t count = 0;
        for (int64_t i = 0; i < m; i++) {
          local[count] = int32_t(i);
#ifdef __AVX512BF16__
          if (use_bf16) narrow[count] = xh.row(nb[i]);
          else
#endif
          rows[count] = xp + int64_t(nb[i]) * cin;
          count += nb[i] >= 0;
        }
#ifdef __AVX512BF16__
        if (use_bf16)
          for (int64_t p = 0; p < panels; p += 4) {
            for (int64_t i = 0; i < count; i++) outs[i] = acc.p + local[i] * wide + p * 16;
            tiles_halves(narrow, outs, halves + (k * panels + p) * pairs * 32, pairs, std::min<int64_t>(4, panels - p), count);
          }
        else
#endif
        for (int64_t p = 0; p < panels; p++) {
          for (int64_t i = 0; i < count; i++) outs[i] = acc.p + local[i] * wide + p * 16;
          tiles(rows, outs, packed.p + (k * panels + p) * cin * 16, cin, count);
        }
        if (norm)
          for (int64_t i = 0; i < count; i++) {
            float* d = den.p + local[i] * wide;
            const float* s = squares.p + k * wide;
            for (int64_t o = 0; o < wide; o++) d[o] += s[o];
          }
      }
      for (int64_t i = 0; i < m; i++)
        for (int64_t p = 0; p < panels; p++) {
          float* a = acc.p + i * wide + p * 16;
          const int64_t o0 = p * 16, width = std::min<int64_t>(16, cout - o0), at = (r0 + i) * cout + o0;
          if (norm) {
            float* d = den.p + i * wide + o0;
            for (int64_t j = 0; j < 16; j++) {
              d[j] = 1.f / std::sqrt(d[j] + 1e-8f);
              a[j] *= d[j];
            }
            std::copy(d, d + width, ip + at);
            std::copy(a, a + width, hp + at);
            for (int64_t j = 0; j < width; j++) a[j] *= gp[o0 + j];
          }
          if (bp)
            for (int64_t j = 0; j < width; j++) a[j] += bp[o0 + j];
          if (relu)
            for (int64_t j = 0; j < 16; j++) a[j] = a[j] > 0.f ? a[j] : 0.f;
          std::copy(a, a + width, yp + at);
        }
    }
  }
  if (norm) return {y, hat, inv};
  return {y};
}

template <int R>
inline void outer(const float* x, const float* g, float* dw, int64_t n) {
  __m256 a[R][2];
#pragma GCC unroll 8
  for (int r = 0; r < R; r++) {
    a[r][0] = _mm256_load_ps(dw + 16 * r);
    a[r][1] = _mm256_load_ps(dw + 16 * r + 8);
  }
  for (int64_t i = 0; i < n; i++) {
    const __m256 g0 = _mm256_load_ps(g + 16 * i), g1 = _mm256_load_ps(g + 16 * i + 8);
#pragma GCC unroll 8
  for (int r = 0; r < R; r++) {
      const __m256 b = _mm256_broadcast_ss(x + 6 * i + r);
      a[r][0] = _mm256_fmadd_ps(b, g0, a[r][0]);
      a[r][1] = _mm256_fmadd_ps(b, g1, a[r][1]);
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < R; r++) {
    _mm256_store_ps(dw + 16 * r, a[r][0]);
    _mm256_store_ps(dw + 16 * r + 8, a[r][1]);
  }
}

// dW[k] = sum over pairs of x[in]^T g[out]. Rows go in blocks whose inputs stay in the cache over all taps; the pairs of a block are
// packed, x in strips of 6 columns and g in panels of 16.
Tensor weight_grad(const Tensor& x, const Tensor& g, const Tensor& map, int64_t cin, int64_t cout) {
  check(map, at::kInt);
  constexpr int64_t CHUNK = 128, SHARES = 8;
  const int64_t taps = map.size(0), n = map.size(1), panels = (cout + 15) / 16, strips = (cin + 5) / 6;
  const int64_t size = panels * strips * 96;
#ifdef HAS_AMX
  if (x.scalar_type() == at::kBFloat16) {
    Tensor dw = torch::empty({taps, cin, cout});
    const amx::Rows xr(static_cast<const uint16_t*>(x.data_ptr()), amx::Packing(taps, cin).wide);
    const amx::Rows gr(static_cast<const uint16_t*>(g.data_ptr()), amx::Packing(taps, cout).wide);
    amx::weight_gradient(xr, cin, gr, cout, map.data_ptr<int32_t>(), taps, n, dw.data_ptr<float>());
    return dw;
  }
#endif
  check(x, at::kFloat);
  check(g, at::kFloat);
  TORCH_CHECK(g.size(0) == n && x.size(1) == cin && g.size(1) == cout, "gradient shapes do not agree");
#ifdef __AVX512BF16__
  if (use_bf16) return weight_grad_halves(x, g, map);
#endif
  Aligned acc(SHARES * taps * size);
  const float *xp = x.data_ptr<float>(), *gp = g.data_ptr<float>();
  const int32_t* mp = map.data_ptr<int32_t>();
#pragma omp parallel
  {
    Aligned gs(panels * CHUNK * 16), xs(strips * CHUNK * 6);
    std::fill(gs.p, gs.p + panels * CHUNK * 16, 0.f);
    std::fill(xs.p, xs.p + strips * CHUNK * 6, 0.f);
    int32_t ins[BLOCK], outs[BLOCK];
#pragma omp for schedule(dynamic, 1)
    for (int64_t share = 0; share < SHARES; share++) {
      float* mine = acc.p + share * taps * size;
      std::fill(mine, mine + taps * size, 0.f);
      const int64_t stop = n * (share + 1) / SHARES;
      for (int64_t r0 = n * share / SHARES; r0 < stop; r0 += BLOCK) {
        const int64_t r1 = std::min(stop, r0 + BLOCK);
        for (int64_t k = 0; k < taps; k++) {
          int64_t pairs = 0;
          for (int64_t i = r0; i < r1; i++) {
            ins[pairs] = mp[k * n + i];
            outs[pairs] = int32_t(i);
            pairs += ins[pairs] >= 0;
          }
          for (int64_t first = 0; first < pairs; first += CHUNK) {
            const int64_t count = std::min(CHUNK, pairs - first);
            for (int64_t j = 0; j < count; j++) {
              const float *src = gp + int64_t(outs[first + j]) * cout, *row = xp + int64_t(ins[first + j]) * cin;
              int64_t p = 0;
              for (; (p + 1) * 16 <= cout; p++) {
                float* to = gs.p + (p * CHUNK + j) * 16;
                _mm256_store_ps(to, _mm256_loadu_ps(src + 16 * p));
                _mm256_store_ps(to + 8, _mm256_loadu_ps(src + 16 * p + 8));
              }
              for (int64_t o = p * 16; o < cout; o++) gs.p[(p * CHUNK + j) * 16 + o % 16] = src[o];
              int64_t s = 0;
              for (; (s + 1) * 6 <= cin; s++) {
                float* to = xs.p + (s * CHUNK + j) * 6;
                _mm_storeu_ps(to, _mm_loadu_ps(row + 6 * s));
                _mm_storel_pi(reinterpret_cast<__m64*>(to + 4), _mm_loadl_pi(_mm_setzero_ps(), reinterpret_cast<const __m64*>(row + 6 * s + 4)));
              }
              for (int64_t c = s * 6; c < cin; c++) xs.p[(s * CHUNK + j) * 6 + c % 6] = row[c];
            }
            for (int64_t p = 0; p < panels; p++)
              for (int64_t s = 0; s < strips; s++) {
                const float *xa = xs.p + s * CHUNK * 6, *ga = gs.p + p * CHUNK * 16;
                float* to = mine + k * size + (p * strips + s) * 96;
                if (cin - 6 * s >= 5) outer<6>(xa, ga, to, count);
                else if (cin - 6 * s >= 4) outer<4>(xa, ga, to, count);
                else outer<3>(xa, ga, to, count);
              }
          }
        }
      }
    }
  }
  Tensor dw = torch::zeros({taps, cin, cout});
  float* dp = dw.data_ptr<float>();
#pragma omp parallel for schedule(static)
  for (int64_t k = 0; k < taps; k++)
    for (int64_t share = 0; share < SHARES; share++)
      for (int64_t c = 0; c < cin; c++)
        for (int64_t o = 0; o < cout; o++)
          dp[(k * cin + c) * cout + o] += acc.p[(share * taps + k) * size + ((o / 16) * strips + c / 6) * 96 + c % 6 * 16 + o % 16];
  return dw;
}

// Sums of partial results, in order.
Tensor join(const Tensor& parts) { return parts.sum(0); }

// Rows of a gradient on their way to products: bf16 on AMX (see `rows`), f32 elsewhere.
struct Gradient {
  Tensor out;
  int64_t c;
#ifdef HAS_AMX
  int64_t stride;
  std::unique_ptr<amx::Rows> half;
#endif
  Gradient(int64_t n, int64_t c_, [[maybe_unused]] int64_t taps) : c(c_) {
#ifdef HAS_AMX
    if (use_amx()) {
      stride = amx::Packing(taps, c).wide;
      out = torch::empty({amx::Rows::size(n, stride)}, torch::kBFloat16);
      half = std::make_unique<amx::Rows>(static_cast<uint16_t*>(out.data_ptr()), n, stride);
      return;
    }
#endif
    out = torch::empty({n, c});
  }
  void set(int64_t i, const float* row) {
#ifdef HAS_AMX
    if (half) return half->set(i, row, c);
#endif
    std::copy(row, row + c, out.data_ptr<float>() + i * c);
  }
};

// Gradient at the accumulator of a plain convolution, and of its bias.
std::vector<Tensor> plain_grad(const Tensor& dy, const Tensor& y, bool relu, int64_t taps) {
  check(dy, at::kFloat);
  check(y, at::kFloat);
  const int64_t n = y.size(0), c = y.size(1);
  Tensor db = torch::zeros({PARTS, c});
  Gradient g(n, c, taps);
  const float *dp = dy.data_ptr<float>(), *yp = y.data_ptr<float>();
  float* bp = db.data_ptr<float>();
#pragma omp parallel for schedule(dynamic, 1)
  for (int64_t part = 0; part < PARTS; part++) {
    std::vector<float> row(c);
    for (int64_t i = n * part / PARTS; i < n * (part + 1) / PARTS; i++) {
      for (int64_t o = 0; o < c; o++) {
        const float v = !relu || yp[i * c + o] > 0 ? dp[i * c + o] : 0.f;
        row[o] = v;
        bp[part * c + o] += v;
      }
      g.set(i, row.data());
    }
  }
  return {g.out, join(db)};
}

// The same for the geometry-invariant form: gradients at the accumulator, of gain and bias, and of the squared norms S[k][o].
std::vector<Tensor> norm_grad(const Tensor& dy, const Tensor& y, const Tensor& hat, const Tensor& inv, const Tensor& gain, const Tensor& map, bool relu) {
  for (const Tensor* t : {&dy, &y, &hat, &inv, &gain}) check(*t, at::kFloat);
  check(map, at::kInt);
  const int64_t n = y.size(0), c = y.size(1), taps = map.size(0);
  Tensor db = torch::zeros({PARTS, c}), dgain = torch::zeros({PARTS, c}), ds = torch::zeros({PARTS, taps, c});
  Gradient g(n, c, taps);
  const float *dp = dy.data_ptr<float>(), *yp = y.data_ptr<float>(), *hp = hat.data_ptr<float>(), *ip = inv.data_ptr<float>(), *ap = gain.data_ptr<float>();
  const int32_t* mp = map.data_ptr<int32_t>();
  float *bp = db.data_ptr<float>(), *np = dgain.data_ptr<float>(), *sp = ds.data_ptr<float>();
#pragma omp parallel for schedule(dynamic, 1)
  for (int64_t part = 0; part < PARTS; part++) {
    std::vector<float> dd(c), row(c);
    for (int64_t i = n * part / PARTS; i < n * (part + 1) / PARTS; i++) {
      for (int64_t o = 0; o < c; o++) {
        const int64_t at = i * c + o;
        const float v = !relu || yp[at] > 0 ? dp[at] : 0.f, gv = v * ap[o] * ip[at];
        bp[part * c + o] += v;
        np[part * c + o] += v * hp[at];
        row[o] = gv;
        dd[o] = -0.5f * gv * hp[at] * ip[at];
      }
      g.set(i, row.data());
      for (int64_t k = 0; k < taps; k++)
        if (mp[k * n + i] >= 0) {
          float* s = sp + (part * taps + k) * c;
          for (int64_t o = 0; o < c; o++) s[o] += dd[o];
        }
    }
  }
  return {g.out, join(dgain), join(db), join(ds)};
}

// End of a block: y = relu?(parts side by side + x), in one pass.
Tensor residual(const std::vector<Tensor>& parts, const Tensor& x, bool relu) {
  check(x, at::kFloat);
  const int64_t n = x.size(0), c = x.size(1);
  Tensor y = torch::empty_like(x);
  int64_t at = 0;
  for (const Tensor& part : parts) {
    check(part, at::kFloat);
    const int64_t w = part.size(1);
    TORCH_CHECK(part.size(0) == n && at + w <= c, "parts do not fit the residual");
    const float *pp = part.data_ptr<float>(), *xp = x.data_ptr<float>() + at;
    float* yp = y.data_ptr<float>() + at;
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n; i++)
      for (int64_t o = 0; o < w; o++) {
        const float v = pp[i * w + o] + xp[i * c + o];
        yp[i * c + o] = relu && v < 0 ? 0.f : v;
      }
    at += w;
  }
  TORCH_CHECK(at == c, "parts do not fill the residual");
  return y;
}

// Gradients of x and of parts `widths` wide.
std::vector<Tensor> residual_grad(const Tensor& dy, const Tensor& y, bool relu, const std::vector<int64_t>& widths) {
  check(dy, at::kFloat);
  check(y, at::kFloat);
  const int64_t n = y.size(0), c = y.size(1);
  std::vector<Tensor> out{relu ? torch::empty_like(y) : dy};
  if (relu) {
    const float *dp = dy.data_ptr<float>(), *yp = y.data_ptr<float>();
    float* xp = out[0].data_ptr<float>();
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n * c; i++) xp[i] = yp[i] > 0 ? dp[i] : 0.f;
  }
  if (widths.size() == 1) return {out[0], out[0]};
  int64_t at = 0;
  for (const int64_t w : widths) {
    Tensor part = torch::empty({n, w});
    const float* from = out[0].data_ptr<float>() + at;
    float* to = part.data_ptr<float>();
#pragma omp parallel for schedule(static)
    for (int64_t i = 0; i < n; i++) std::copy(from + i * c, from + i * c + w, to + i * w);
    out.push_back(part);
    at += w;
  }
  return out;
}

// Mean over the children [first[i], first[i + 1]) of each parent, and its gradient.
Tensor pool(const Tensor& x, const Tensor& first) {
  check(x, at::kFloat);
  check(first, at::kInt);
  const int64_t n = first.size(0) - 1, c = x.size(1);
  Tensor y = torch::zeros({n, c});
  const float* xp = x.data_ptr<float>();
  const int32_t* f = first.data_ptr<int32_t>();
  float* yp = y.data_ptr<float>();
#pragma omp parallel for schedule(dynamic, 256)
  for (int64_t i = 0; i < n; i++) {
    for (int64_t j = f[i]; j < f[i + 1]; j++)
      for (int64_t o = 0; o < c; o++) yp[i * c + o] += xp[j * c + o];
    const float s = 1.f / float(f[i + 1] - f[i]);
    for (int64_t o = 0; o < c; o++) yp[i * c + o] *= s;
  }
  return y;
}

Tensor pool_grad(const Tensor& dy, const Tensor& first, int64_t rows) {
  check(dy, at::kFloat);
  check(first, at::kInt);
  const int64_t n = first.size(0) - 1, c = dy.size(1);
  Tensor dx = torch::empty({rows, c});
  const float* dp = dy.data_ptr<float>();
  const int32_t* f = first.data_ptr<int32_t>();
  float* xp = dx.data_ptr<float>();
#pragma omp parallel for schedule(dynamic, 256)
  for (int64_t i = 0; i < n; i++) {
    const float s = 1.f / float(f[i + 1] - f[i]);
    for (int64_t j = f[i]; j < f[i + 1]; j++)
      for (int64_t o = 0; o < c; o++) xp[j * c + o] = dp[i * c + o] * s;
  }
  return dx;
}

// ---------------------------------------------------------------------------------------------------------------
// Splatter. Cameras: world-to-camera rotation (9), translation (3), fx, fy, cx, cy.

constexpr float ALPHA_MAX = 0.99f, ALPHA_MIN = 1.f / 16384, T_MIN = 1e-4f, NEAR = 1e-2f;
// What every splat is widened by: so much of a finest voxel squared, or of a pixel squared if that is more.
constexpr float VOXEL_BLUR = 0.15f, PIXEL_BLUR = 1.f / 64;
constexpr int TILE = 16;

struct View {
  float r[9], t[3], fx, fy, cx, cy;
  explicit View(const float* c) {
    std::copy(c, c + 9, r);
    std::copy(c + 9, c + 12, t);
    fx = c[12], fy = c[13], cx = c[14], cy = c[15];
  }
};

struct Projected {
  float x, y, z, m[6];      // camera coordinates; M = J R, 2 x 3
  float u, v, a, b, c;      // pixel and inverse covariance
  float ex, ey;             // half extents at ALPHA_MIN
  bool seen;
};

float voxel_blur(const View& w, float iz) { return VOXEL_BLUR * w.fx * w.fy * iz * iz; }

Projected project(const View& w, const float* p, const float* s, float opacity) {
  Projected q{};
  q.x = w.r[0] * p[0] + w.r[1] * p[1] + w.r[2] * p[2] + w.t[0];
  q.y = w.r[3] * p[0] + w.r[4] * p[1] + w.r[5] * p[2] + w.t[1];
  q.z = w.r[6] * p[0] + w.r[7] * p[1] + w.r[8] * p[2] + w.t[2];
  if (!(q.z > NEAR) || !(opacity >= ALPHA_MIN)) return q;
  const float iz = 1 / q.z, j00 = w.fx * iz, j02 = -w.fx * q.x * iz * iz, j11 = w.fy * iz, j12 = -w.fy * q.y * iz * iz;
  for (int k = 0; k < 3; k++) {
    q.m[k] = j00 * w.r[k] + j02 * w.r[6 + k];
    q.m[3 + k] = j11 * w.r[3 + k] + j12 * w.r[6 + k];
  }
  const float* m = q.m;  // covariance order: xx xy xz yy yz zz
  float h[6];
  for (int i = 0; i < 2; i++) {
    h[3 * i] = m[3 * i] * s[0] + m[3 * i + 1] * s[1] + m[3 * i + 2] * s[2];
    h[3 * i + 1] = m[3 * i] * s[1] + m[3 * i + 1] * s[3] + m[3 * i + 2] * s[4];
    h[3 * i + 2] = m[3 * i] * s[2] + m[3 * i + 1] * s[4] + m[3 * i + 2] * s[5];
  }
  const float blur = std::max(PIXEL_BLUR, voxel_blur(w, iz));
  const float xx = h[0] * m[0] + h[1] * m[1] + h[2] * m[2] + blur, xy = h[0] * m[3] + h[1] * m[4] + h[2] * m[5],
              yy = h[3] * m[3] + h[4] * m[4] + h[5] * m[5] + blur, det = xx * yy - xy * xy;
  if (!(det > 0)) return q;
  q.a = yy / det, q.b = -xy / det, q.c = xx / det;
  q.u = w.fx * q.x * iz + w.cx, q.v = w.fy * q.y * iz + w.cy;
  const float reach = 2 * std::log(opacity / ALPHA_MIN);
  q.ex = std::sqrt(std::max(0.f, reach * xx)), q.ey = std::sqrt(std::max(0.f, reach * yy));
  q.seen = true;
  return q;
}

// exp for arguments in [-87, 0]: relative error below 2e-7.
inline __m256 exp8(__m256 x) {
  x = _mm256_max_ps(x, _mm256_set1_ps(-87.f));
  const __m256 n = _mm256_round_ps(_mm256_mul_ps(x, _mm256_set1_ps(1.44269504f)), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
  __m256 f = _mm256_fnmadd_ps(n, _mm256_set1_ps(0.693359375f), x);
  f = _mm256_fnmadd_ps(n, _mm256_set1_ps(-2.12194440e-4f), f);
  __m256 p = _mm256_set1_ps(1.9875691500e-4f);
  for (float c : {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f})
    p = _mm256_fmadd_ps(p, f, _mm256_set1_ps(c));
  p = _mm256_fmadd_ps(p, _mm256_mul_ps(f, f), _mm256_add_ps(f, _mm256_set1_ps(1.f)));
  const __m256i e = _mm256_slli_epi32(_mm256_add_epi32(_mm256_cvtps_epi32(n), _mm256_set1_epi32(127)), 23);
  return _mm256_mul_ps(p, _mm256_castsi256_ps(e));
}

float sum8(__m256 v) {
  __m128 s = _mm_add_ps(_mm256_castps256_ps128(v), _mm256_extractf128_ps(v, 1));
  s = _mm_add_ps(s, _mm_movehl_ps(s, s));
  return _mm_cvtss_f32(_mm_add_ss(s, _mm_movehdup_ps(s)));
}

// Splats of each tile in depth order, per view: `lists` holds the splats, `starts` the first entry of each tile.
struct Scene {
  int64_t n, views, width, height, tx, ty;
  const float *mean, *cov, *opacity, *colour, *cameras;
};

Scene scene_of(const Tensor& mean, const Tensor& cov, const Tensor& opacity, const Tensor& colour, const Tensor& cameras, int64_t width, int64_t height) {
  for (const Tensor* t : {&mean, &cov, &opacity, &colour, &cameras}) check(*t, at::kFloat);
  return {mean.size(0), cameras.size(0), width, height, (width + TILE - 1) / TILE, (height + TILE - 1) / TILE,
          mean.data_ptr<float>(), cov.data_ptr<float>(), opacity.data_ptr<float>(), colour.data_ptr<float>(), cameras.data_ptr<float>()};
}

void bin(const Scene& s, const std::vector<Projected>& q, std::vector<int32_t>& list, std::vector<int64_t>& start) {
  std::vector<std::pair<float, int32_t>> order;
  for (int64_t i = 0; i < s.n; i++)
    if (q[i].seen) order.emplace_back(q[i].z, int32_t(i));
  std::sort(order.begin(), order.end());
  start.assign(s.tx * s.ty + 1, 0);
  for (int pass = 0; pass < 2; pass++) {
    for (const auto& [z, i] : order) {
      const Projected& p = q[i];
      const int64_t x0 = std::max<int64_t>(0, int64_t(std::floor((p.u - p.ex - 0.5f) / TILE))), x1 = std::min<int64_t>(s.tx - 1, int64_t(std::floor((p.u + p.ex - 0.5f) / TILE)));
      const int64_t y0 = std::max<int64_t>(0, int64_t(std::floor((p.v - p.ey - 0.5f) / TILE))), y1 = std::min<int64_t>(s.ty - 1, int64_t(std::floor((p.v + p.ey - 0.5f) / TILE)));
      for (int64_t y = y0; y <= y1; y++)
        for (int64_t x = x0; x <= x1; x++) {
          if (pass == 0) start[y * s.tx + x + 1]++;
          else list[start[y * s.tx + x]++] = i;
        }
    }
    if (pass == 0) {
      std::partial_sum(start.begin(), start.end(), start.begin());
      list.resize(start.back());
    } else {
      for (int64_t t = s.tx * s.ty; t > 0; t--) start[t] = start[t - 1];
      start[0] = 0;
    }
  }
}

struct Rows {
  int y0, y1;
  bool half[2];
};

Rows rows_of(const Projected& p, float left, float top) {
  Rows r;
  r.y0 = std::max(0, int(std::ceil(p.v - p.ey - 0.5f - top)));
  r.y1 = std::min(TILE - 1, int(std::floor(p.v + p.ey - 0.5f - top)));
  r.half[0] = p.u - p.ex < left + 8;
  r.half[1] = p.u + p.ex > left + 8;
  return r;
}

Tensor splat(const Tensor& mean, const Tensor& cov, const Tensor& opacity, const Tensor& colour, const Tensor& cameras, const Tensor& background, int64_t width, int64_t height) {
  const Scene s = scene_of(mean, cov, opacity, colour, cameras, width, height);
  check(background, at::kFloat);
  Tensor image = torch::empty({s.views, 3, height, width});
  float* out = image.data_ptr<float>();
  const float* bg = background.data_ptr<float>();
  for (int64_t view = 0; view < s.views; view++) {
    const View w(s.cameras + 16 * view);
    std::vector<Projected> q(s.n);
#pragma omp parallel for schedule(dynamic, 1024)
    for (int64_t i = 0; i < s.n; i++) q[i] = project(w, s.mean + 3 * i, s.cov + 6 * i, s.opacity[i]);
    std::vector<int32_t> list;
    std::vector<int64_t> start;
    bin(s, q, list, start);
#pragma omp parallel for schedule(dynamic, 2)
    for (int64_t t = 0; t < s.tx * s.ty; t++) {
      const float left = float(t % s.tx * TILE), top = float(t / s.tx * TILE);
      alignas(32) float tr[TILE * TILE], c[3][TILE * TILE];
      std::fill(tr, tr + TILE * TILE, 1.f);
      std::fill(&c[0][0], &c[0][0] + 3 * TILE * TILE, 0.f);
      const __m256 lane = _mm256_setr_ps(0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f);
      for (int64_t e = start[t]; e < start[t + 1]; e++) {
        const int32_t i = list[e];
        const Projected& p = q[i];
        const Rows rows = rows_of(p, left, top);
        const float* col = s.colour + 3 * i;
        for (int h = 0; h < 2; h++) {
          if (!rows.half[h]) continue;
          const __m256 dx = _mm256_add_ps(lane, _mm256_set1_ps(left + 8.f * h - p.u)), xx = _mm256_mul_ps(_mm256_mul_ps(dx, dx), _mm256_set1_ps(-0.5f * p.a));
          for (int y = rows.y0; y <= rows.y1; y++) {
            const float dy = top + y + 0.5f - p.v;
            const int at = y * TILE + 8 * h;
            const __m256 power = _mm256_fmadd_ps(dx, _mm256_set1_ps(-p.b * dy), _mm256_add_ps(xx, _mm256_set1_ps(-0.5f * p.c * dy * dy)));
            const __m256 alpha = _mm256_min_ps(_mm256_set1_ps(ALPHA_MAX), _mm256_mul_ps(_mm256_set1_ps(s.opacity[i]), exp8(_mm256_min_ps(power, _mm256_setzero_ps()))));
            const __m256 T = _mm256_load_ps(tr + at);
            const __m256 on = _mm256_and_ps(_mm256_cmp_ps(alpha, _mm256_set1_ps(ALPHA_MIN), _CMP_GE_OQ), _mm256_cmp_ps(T, _mm256_set1_ps(T_MIN), _CMP_GE_OQ));
            const __m256 wt = _mm256_and_ps(on, _mm256_mul_ps(alpha, T));
            for (int k = 0; k < 3; k++) _mm256_store_ps(c[k] + at, _mm256_fmadd_ps(wt, _mm256_set1_ps(col[k]), _mm256_load_ps(c[k] + at)));
            _mm256_store_ps(tr + at, _mm256_sub_ps(T, wt));
          }
        }
        if ((e - start[t]) % 64 == 63 && *std::max_element(tr, tr + TILE * TILE) < T_MIN) break;
      }
      for (int y = 0; y < TILE; y++)
        for (int x = 0; x < TILE; x++) {
          const int64_t px = int64_t(left) + x, py = int64_t(top) + y;
          if (px >= width || py >= height) continue;
          for (int k = 0; k < 3; k++) out[((view * 3 + k) * height + py) * width + px] = c[k][y * TILE + x] + tr[y * TILE + x] * bg[3 * view + k];
        }
    }
  }
  return image;
}

// Gradients of mean, covariance, opacity and colour for the picture's gradient `dimage`.
std::vector<Tensor> splat_grad(const Tensor& mean, const Tensor& cov, const Tensor& opacity, const Tensor& colour, const Tensor& cameras, const Tensor& image, const Tensor& dimage) {
  const int64_t height = image.size(2), width = image.size(3);
  const Scene s = scene_of(mean, cov, opacity, colour, cameras, width, height);
  check(image, at::kFloat);
  check(dimage, at::kFloat);
  Tensor dmean = torch::zeros_like(mean), dcov = torch::zeros_like(cov), dopacity = torch::zeros_like(opacity), dcolour = torch::zeros_like(colour);
  float *gm = dmean.data_ptr<float>(), *gc = dcov.data_ptr<float>(), *go = dopacity.data_ptr<float>(), *gk = dcolour.data_ptr<float>();
  const float *im = image.data_ptr<float>(), *di = dimage.data_ptr<float>();
  for (int64_t view = 0; view < s.views; view++) {
    const View w(s.cameras + 16 * view);
    std::vector<Projected> q(s.n);
#pragma omp parallel for schedule(dynamic, 1024)
    for (int64_t i = 0; i < s.n; i++) q[i] = project(w, s.mean + 3 * i, s.cov + 6 * i, s.opacity[i]);
    std::vector<int32_t> list;
    std::vector<int64_t> start;
    bin(s, q, list, start);
    std::vector<float> part(list.size() * 9, 0.f);  // per entry: colour 3, opacity, u, v, a, b, c
#pragma omp parallel for schedule(dynamic, 2)
    for (int64_t t = 0; t < s.tx * s.ty; t++) {
      const float left = float(t % s.tx * TILE), top = float(t / s.tx * TILE);
      alignas(32) float tr[TILE * TILE], rest[TILE * TILE], g[3][TILE * TILE];
      // `rest` is what the picture's gradient still sees behind the current splat: it starts as C . dC.
      for (int y = 0; y < TILE; y++)
        for (int x = 0; x < TILE; x++) {
          const int64_t px = int64_t(left) + x, py = int64_t(top) + y;
          const bool in = px < width && py < height;
          const int at = y * TILE + x;
          rest[at] = 0;
          tr[at] = in ? 1.f : 0.f;
          for (int k = 0; k < 3; k++) {
            const int64_t src = ((view * 3 + k) * height + py) * width + px;
            g[k][at] = in ? di[src] : 0.f;
            rest[at] += in ? di[src] * im[src] : 0.f;
          }
        }
      const __m256 lane = _mm256_setr_ps(0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f), zero = _mm256_setzero_ps(), one = _mm256_set1_ps(1.f);
      for (int64_t e = start[t]; e < start[t + 1]; e++) {
        const int32_t i = list[e];
        const Projected& p = q[i];
        const Rows rows = rows_of(p, left, top);
        const float* col = s.colour + 3 * i;
        __m256 s0 = zero, s1 = zero, s2 = zero, so = zero, sx = zero, sy = zero, sxx = zero, sxy = zero, syy = zero;
        for (int h = 0; h < 2; h++) {
          if (!rows.half[h]) continue;
          const __m256 dx = _mm256_add_ps(lane, _mm256_set1_ps(left + 8.f * h - p.u)), xx = _mm256_mul_ps(_mm256_mul_ps(dx, dx), _mm256_set1_ps(-0.5f * p.a));
          for (int y = rows.y0; y <= rows.y1; y++) {
            const float dy = top + y + 0.5f - p.v;
            const __m256 vdy = _mm256_set1_ps(dy);
            const int at = y * TILE + 8 * h;
            const __m256 power = _mm256_fmadd_ps(dx, _mm256_set1_ps(-p.b * dy), _mm256_add_ps(xx, _mm256_set1_ps(-0.5f * p.c * dy * dy)));
            const __m256 ex = exp8(_mm256_min_ps(power, zero)), full = _mm256_mul_ps(_mm256_set1_ps(s.opacity[i]), ex), alpha = _mm256_min_ps(_mm256_set1_ps(ALPHA_MAX), full);
            const __m256 T = _mm256_load_ps(tr + at);
            const __m256 on = _mm256_and_ps(_mm256_cmp_ps(alpha, _mm256_set1_ps(ALPHA_MIN), _CMP_GE_OQ), _mm256_cmp_ps(T, _mm256_set1_ps(T_MIN), _CMP_GE_OQ));
            const __m256 wt = _mm256_and_ps(on, _mm256_mul_ps(alpha, T));
            const __m256 g0 = _mm256_load_ps(g[0] + at), g1 = _mm256_load_ps(g[1] + at), g2 = _mm256_load_ps(g[2] + at);
            const __m256 cd = _mm256_fmadd_ps(g0, _mm256_set1_ps(col[0]), _mm256_fmadd_ps(g1, _mm256_set1_ps(col[1]), _mm256_mul_ps(g2, _mm256_set1_ps(col[2]))));
            const __m256 behind = _mm256_fnmadd_ps(wt, cd, _mm256_load_ps(rest + at));
            _mm256_store_ps(rest + at, behind);
            _mm256_store_ps(tr + at, _mm256_sub_ps(T, wt));
            s0 = _mm256_fmadd_ps(wt, g0, s0);
            s1 = _mm256_fmadd_ps(wt, g1, s1);
            s2 = _mm256_fmadd_ps(wt, g2, s2);
            const __m256 free = _mm256_and_ps(on, _mm256_cmp_ps(full, _mm256_set1_ps(ALPHA_MAX), _CMP_LT_OQ));
            const __m256 da = _mm256_and_ps(free, _mm256_sub_ps(_mm256_mul_ps(T, cd), _mm256_div_ps(behind, _mm256_sub_ps(one, alpha))));
            so = _mm256_fmadd_ps(ex, da, so);
            const __m256 dp = _mm256_mul_ps(alpha, da), px = _mm256_mul_ps(dp, dx), py = _mm256_mul_ps(dp, vdy);
            sx = _mm256_add_ps(sx, px);
            sy = _mm256_add_ps(sy, py);
            sxx = _mm256_fmadd_ps(px, dx, sxx);
            sxy = _mm256_fmadd_ps(px, vdy, sxy);
            syy = _mm256_fmadd_ps(py, vdy, syy);
          }
        }
        float* o = part.data() + e * 9;
        const float vx = sum8(sx), vy = sum8(sy);
        o[0] = sum8(s0), o[1] = sum8(s1), o[2] = sum8(s2), o[3] = sum8(so);
        o[4] = p.a * vx + p.b * vy, o[5] = p.c * vy + p.b * vx;
        o[6] = -0.5f * sum8(sxx), o[7] = -sum8(sxy), o[8] = -0.5f * sum8(syy);
        if ((e - start[t]) % 64 == 63 && *std::max_element(tr, tr + TILE * TILE) < T_MIN) break;
      }
    }
    std::vector<float> sums(s.n * 9, 0.f);
    for (size_t e = 0; e < list.size(); e++)
      for (int k = 0; k < 9; k++) sums[list[e] * 9 + k] += part[e * 9 + k];
#pragma omp parallel for schedule(dynamic, 1024)
    for (int64_t i = 0; i < s.n; i++) {
      const Projected& p = q[i];
      if (!p.seen) continue;
      const float* d = sums.data() + i * 9;
      for (int k = 0; k < 3; k++) gk[3 * i + k] += d[k];
      go[i] += d[3];
      // d inverse -> d covariance: -M G M with G = [[da, db/2], [db/2, dc]].
      const float ga = d[6], gb = 0.5f * d[7], gcc = d[8];
      const float m00 = p.a * ga + p.b * gb, m01 = p.a * gb + p.b * gcc, m10 = p.b * ga + p.c * gb, m11 = p.b * gb + p.c * gcc;
      const float xx = -(m00 * p.a + m01 * p.b), xy = -(m00 * p.b + m01 * p.c), yy = -(m10 * p.b + m11 * p.c);
      const float *m = p.m, *sg = s.cov + 6 * i;
      float gmx[6];  // [[xx, xy], [xy, yy]] M
      for (int k = 0; k < 3; k++) gmx[k] = xx * m[k] + xy * m[3 + k], gmx[3 + k] = xy * m[k] + yy * m[3 + k];
      const int at[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
      for (int a = 0; a < 3; a++)
        for (int b = a; b < 3; b++) {
          const float v = m[a] * gmx[b] + m[3 + a] * gmx[3 + b], vt = m[b] * gmx[a] + m[3 + b] * gmx[3 + a];
          gc[6 * i + at[a][b]] += a == b ? v : v + vt;
        }
      float dm[6];  // 2 G M Sigma
      for (int r = 0; r < 2; r++)
        for (int k = 0; k < 3; k++) dm[3 * r + k] = 2 * (gmx[3 * r] * sg[at[0][k]] + gmx[3 * r + 1] * sg[at[1][k]] + gmx[3 * r + 2] * sg[at[2][k]]);
      const float* R = w.r;
      auto dot = [&](int row, int cam) { return dm[3 * row] * R[3 * cam] + dm[3 * row + 1] * R[3 * cam + 1] + dm[3 * row + 2] * R[3 * cam + 2]; };
      const float d00 = dot(0, 0), d02 = dot(0, 2), d11 = dot(1, 1), d12 = dot(1, 2), iz = 1 / p.z, iz2 = iz * iz, iz3 = iz2 * iz;
      const float tx = -d02 * w.fx * iz2 + d[4] * w.fx * iz, ty = -d12 * w.fy * iz2 + d[5] * w.fy * iz;
      const float widened = voxel_blur(w, iz) > PIXEL_BLUR ? -2 * voxel_blur(w, iz) * iz * (xx + yy) : 0.f;
      const float tz = widened - d00 * w.fx * iz2 + 2 * d02 * w.fx * p.x * iz3 - d11 * w.fy * iz2 + 2 * d12 * w.fy * p.y * iz3 - d[4] * w.fx * p.x * iz2 - d[5] * w.fy * p.y * iz2;
      for (int k = 0; k < 3; k++) gm[3 * i + k] += R[k] * tx + R[3 + k] * ty + R[6 + k] * tz;
    }
  }
  return {dmean, dcov, dopacity, dcolour};
}

}  // namespace

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
  using release = pybind11::call_guard<pybind11::gil_scoped_release>;
  m.def("kernel_map", &kernel_map, release());
  m.def("child_map", &child_map, release());
  m.def("rows", &rows, release());
  m.def("conv", &conv, release());
  m.def("set_bf16", &set_bf16);
  m.def("use_amx", &use_amx);
  m.def("weight_grad", &weight_grad, release());
  m.def("plain_grad", &plain_grad, release());
  m.def("norm_grad", &norm_grad, release());
  m.def("residual", &residual, release());
  m.def("residual_grad", &residual_grad, release());
  m.def("pool", &pool, release());
  m.def("pool_grad", &pool_grad, release());
  m.def("splat", &splat, release());
  m.def("splat_grad", &splat_grad, release());
}
