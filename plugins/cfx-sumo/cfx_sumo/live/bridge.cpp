// What SUMO knows of many vehicles in one call. The functions are libsumo's own, by their addresses.
#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>
#include <unordered_map>
#include <utility>
#include <vector>

#if !defined(_GLIBCXX_USE_CXX11_ABI) || !_GLIBCXX_USE_CXX11_ABI
#error "libsumo's strings are those of libstdc++'s C++11 ABI"
#endif

using Getter = double (*)(const std::string&);
using Leader = std::pair<std::string, double> (*)(const std::string&, double);
using Setter = void (*)(const std::string&, double);

// Reads vehicles: gap to the leader without minGap, then the values of four getters, `(count, 5)`.
// Names end with 0. A leader's row is its place among the vehicles, -2 where there is none, -1 where
// it is another vehicle, whose name is then among `others`, and what the first two getters say of it
// among `motions`, `(others, 2)`. Before, `rows` say where leaders were last: mostly they are there
// again. Returns the length of the others' names; -1: SUMO does not know a vehicle; -2: there is too
// little room.
extern "C" int64_t cfx_read(Leader leader_of, const Getter* getters, int64_t count,
                            const char* names, double reach, double* values, int64_t* rows,
                            char* others, double* motions, int64_t room) {
    std::vector<std::string_view> known;
    known.reserve(count);
    for (const char* at = names; static_cast<int64_t>(known.size()) < count;) {
        known.emplace_back(at);
        at += known.back().size() + 1;
    }
    std::unordered_map<std::string_view, int64_t> places;
    char* end = others;
    std::string name;
    try {
        for (int64_t i = 0; i < count; ++i) {
            name = known[i];
            const auto leader = leader_of(name, reach);
            double* value = values + 5 * i;
            *value = leader.second;
            for (int k = 0; k < 4; ++k) value[k + 1] = getters[k](name);
            const int64_t last = rows[i];
            if (last >= 0 && last < count && known[last] == leader.first) continue;
            rows[i] = -2;
            if (leader.first.empty()) continue;
            if (places.empty()) {
                places.reserve(2 * count);
                for (int64_t k = 0; k < count; ++k) places.emplace(known[k], k);
            }
            const auto found = places.find(leader.first);
            rows[i] = found == places.end() ? -1 : found->second;
            if (rows[i] >= 0) continue;
            const int64_t size = static_cast<int64_t>(leader.first.size()) + 1;
            if (end + size > others + room) return -2;
            std::memcpy(end, leader.first.c_str(), size);
            end += size;
            for (int k = 0; k < 2; ++k) *motions++ = getters[k](leader.first);
        }
    } catch (...) {
        return -1;
    }
    return end - others;
}

// Tells SUMO the next speeds of vehicles. Returns how many it took.
extern "C" int64_t cfx_tell(Setter tell, int64_t count, const char* names, const double* speeds) {
    const char* at = names;
    std::string name;
    for (int64_t i = 0; i < count; ++i) {
        name = at;
        at += name.size() + 1;
        try {
            tell(name, speeds[i]);
        } catch (...) {
            return i;
        }
    }
    return count;
}
