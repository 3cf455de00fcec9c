// What SUMO knows of many vehicles in one call. The functions are libsumo's own, by their addresses.
#include <cmath>
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
using Word = std::string (*)(const std::string&);
using Setter = void (*)(const std::string&, double);

// Signals of a vehicle, in the order of `Seen` in surroundings.py.
enum { SPEED, ACCELERATION, GAP, LEADER_SPEED, LEADER_ACCELERATION, ALLOWED, MIN_GAP, SIGNALS };
enum { ANOTHER = -1, NOBODY = -2 };

// Reads vehicles and who is ahead of them.
//
// Names end with 0. `signals` are `(SIGNALS, count)`. A leader's row is its place among the vehicles,
// NOBODY where there is none, ANOTHER where it is another vehicle, whose name is then among `others`.
// `follows` says whose leader is near enough; the others get a leader as fast as they are at
// `free_road`. SUMO's own gap leaves minGap out, and at some junctions it is -1.8e308 m, of nobody.
//
// Before, `rows` and `follows` are those of the last reading: mostly leaders are there again; how
// many are not is counted in `changes`. Returns the length of the others' names; -1: SUMO does not
// know a vehicle; -2: there is too little room.
extern "C" int64_t cfx_read(Leader leader_of, const Getter* getters, int64_t count,
                            const char* names, double reach, double free_road, double* signals,
                            int64_t* rows, uint8_t* follows, char* others, int64_t room,
                            int64_t* changes) {
    std::vector<std::string_view> known;
    known.reserve(count);
    for (const char* at = names; static_cast<int64_t>(known.size()) < count;) {
        known.emplace_back(at);
        at += known.back().size() + 1;
    }
    const auto signal = [&](int number) { return signals + number * count; };
    const int read[] = {SPEED, ACCELERATION, MIN_GAP, ALLOWED};
    std::unordered_map<std::string_view, int64_t> places;
    char* end = others;
    std::string name;
    *changes = 0;
    try {
        for (int64_t i = 0; i < count; ++i) {
            name = known[i];
            const auto leader = leader_of(name, reach);
            for (int k = 0; k < 4; ++k) signal(read[k])[i] = getters[k](name);
            const int64_t last = rows[i];
            if (last < 0 || last >= count || known[last] != leader.first) {
                rows[i] = NOBODY;
                if (!leader.first.empty()) {
                    if (places.empty()) {
                        places.reserve(2 * count);
                        for (int64_t k = 0; k < count; ++k) places.emplace(known[k], k);
                    }
                    const auto found = places.find(leader.first);
                    rows[i] = found == places.end() ? ANOTHER : found->second;
                }
                *changes += rows[i] != last;
            }
            const double gap = leader.second + signal(MIN_GAP)[i];
            const bool near = rows[i] != NOBODY && std::fabs(leader.second) <= free_road &&
                              gap <= reach;
            *changes += near != static_cast<bool>(follows[i]);
            follows[i] = near;
            signal(GAP)[i] = near ? gap : free_road;
            if (!near) {
                signal(MIN_GAP)[i] = 0;
                signal(LEADER_SPEED)[i] = signal(SPEED)[i];
                signal(LEADER_ACCELERATION)[i] = 0;
            }
            if (rows[i] != ANOTHER) continue;
            const int64_t size = static_cast<int64_t>(leader.first.size()) + 1;
            if (end + size > others + room) return -2;
            std::memcpy(end, leader.first.c_str(), size);
            end += size;
            if (!near) continue;
            signal(LEADER_SPEED)[i] = getters[0](leader.first);
            signal(LEADER_ACCELERATION)[i] = getters[1](leader.first);
        }
    } catch (...) {
        return -1;
    }
    for (int64_t i = 0; i < count; ++i) {
        if (!follows[i] || rows[i] < 0) continue;
        signal(LEADER_SPEED)[i] = signal(SPEED)[rows[i]];
        signal(LEADER_ACCELERATION)[i] = signal(ACCELERATION)[rows[i]];
    }
    return end - others;
}

// Reads one word of each vehicle, such as its lane; words end with 0. Returns their length; -1 and -2
// as above.
extern "C" int64_t cfx_words(Word word_of, int64_t count, const char* names, char* words,
                             int64_t room) {
    char* end = words;
    std::string name;
    try {
        for (int64_t i = 0; i < count; ++i) {
            name = names;
            names += name.size() + 1;
            const std::string word = word_of(name);
            const int64_t size = static_cast<int64_t>(word.size()) + 1;
            if (end + size > words + room) return -2;
            std::memcpy(end, word.c_str(), size);
            end += size;
        }
    } catch (...) {
        return -1;
    }
    return end - words;
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
