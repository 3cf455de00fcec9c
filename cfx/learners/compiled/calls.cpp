// Runs the calls of a closed loop, window by window: see calls.py, whose Operand and Calls fill the
// structures below. Networks are A there and `n` here; each thread takes networks begin to end - 1.
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

// A tensor (A, B, C, width): where it lies, and its strides.
struct Array { float* data; long a, b, c, column; };
// The tensor in the slot of window 0, elements from slot to slot, and how many slots there are.
struct Operand { Array first; long step, offset, ring; };
// One call: which operands it has, the sizes B and C of the first, and what its kind needs.
struct Call { long kind; void (*function)(const Array*, long, long, long, long);
              long operand, count, B, C, inner, outer, accumulates, except_window; };
enum { ELEMENTWISE, PRODUCT, BOUND, ADD };
typedef float Lane __attribute__((vector_size(32), aligned(4), may_alias));

// R rows of 16 columns of x w: sums of 16 columns are two registers of 8 numbers for each row, which
// stay there for the whole inner dimension.
template <int R> static inline void tile(const float* x, long xs, const float* w, long inner,
                                         float* out, long os, long width, bool accumulates) {
  Lane low[R] = {}, high[R] = {};
  for (long k = 0; k < inner; ++k, w += 16) {
    const Lane l = *(const Lane*)w, h = *(const Lane*)(w + 8);
    for (int r = 0; r < R; ++r) {
      const float value = x[r * xs + k];
      low[r] += value * l;
      high[r] += value * h;
    }
  }
  for (int r = 0; r < R; ++r, out += os) {
    if (width == 16) {
      Lane* to = (Lane*)out;
      to[0] = accumulates ? to[0] + low[r] : low[r];
      to[1] = accumulates ? to[1] + high[r] : high[r];
    } else for (long j = 0; j < width; ++j) {
      const float value = j < 8 ? low[r][j] : high[r][j - 8];
      out[j] = accumulates ? out[j] + value : value;
    }
  }
}

// to = x w, or to += x w, of network n. Six rows at once fill twelve of the sixteen registers.
static void product(const Array& x, const Array& to, const Array& w, long n, const Call& call) {
  const long rows = call.C, inner = call.inner, outer = call.outer, adds = call.accumulates;
  for (long g = 0; g < outer; g += 16) {
    const float* panel = w.data + n * w.a + g * inner;
    const long width = std::min(16L, outer - g);
    long r = 0;
    const auto at = [&] { return x.data + n * x.a + r * x.c; };
    const auto out = [&] { return to.data + n * to.a + r * to.c + g; };
    for (; r + 6 <= rows; r += 6) tile<6>(at(), x.c, panel, inner, out(), to.c, width, adds);
    for (; r + 2 <= rows; r += 2) tile<2>(at(), x.c, panel, inner, out(), to.c, width, adds);
    for (; r < rows; ++r) tile<1>(at(), x.c, panel, inner, out(), to.c, width, adds);
  }
}

// ADD adds one array to another. BOUND scales and clips one; NaN and infinity, whose difference from
// themselves is not 0, become 0.
static void each(const Array* of, long begin, long end, const Call& call) {
  for (long n = begin; n < end; ++n) for (long b = 0; b < call.B; ++b)
  for (long k = 0; k < call.outer; ++k) {
    float* to = of[0].data + n * of[0].a + b * of[0].b + k * of[0].column;
    const float* by = of[1].data + n * of[1].a + b * of[1].b + k * of[1].column;
    if (call.kind == ADD) {
      for (long c = 0; c < call.C; ++c) to[c * of[0].c] += by[c * of[1].c];
      continue;
    }
    const float scale = of[1].data[0], largest = of[1].data[1];
    for (long c = 0; c < call.C; ++c) {
      float value = to[c * of[0].c];
      value = (value - value == 0 ? value : 0) * scale;
      to[c * of[0].c] = std::min(std::max(value, -largest), largest);
    }
  }
}

// All calls in order, for each window from first to last in steps of `way` (-1: backwards).
extern "C" void run(const Call* calls, long count, const Operand* operands, long first, long last,
                    long way, long begin, long end) {
  std::vector<Array> arrays;
  for (long window = first; window != last; window += way)
  for (const Call* call = calls; call < calls + count; ++call) {
    if (call->except_window == window) continue;
    arrays.clear();
    for (const Operand* o = operands + call->operand; long(arrays.size()) < call->count; ++o) {
      arrays.push_back(o->first);
      if (o->step) arrays.back().data += (window + o->offset) % o->ring * o->step;
    }
    if (call->kind == ELEMENTWISE) call->function(arrays.data(), begin, end, call->B, call->C);
    else if (call->kind == PRODUCT)
      for (long n = begin; n < end; ++n) product(arrays[0], arrays[1], arrays[2], n, *call);
    else each(arrays.data(), begin, end, *call);
  }
}
